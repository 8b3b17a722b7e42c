"""Make the documentation's pictures: overview, chairs, annotator, conventions, architecture.

    python scripts/make_pictures.py overview

The annotator's photo and model are those of `chairs`, whose files are needed:

    python scripts/make_pictures.py chairs --files chairs
    python scripts/make_pictures.py annotator --files chairs
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Sequence
from html import escape
from pathlib import Path

import cv2
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes

from cadalign import Alignment, Box, Camera, Observation, fit
from cadalign.annotate.lines import Wireframe
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.opening import open_session
from cadalign.annotate.options import SessionOptions
from cadalign.datasets import AnnotatedModel, KeypointNet, ModelKeypoints, write_sample_dataset
from cadalign.evaluation.instances.instance import load_scene, make_instance
from cadalign.io.images import read_image, write_image
from cadalign.render import (
    Angles,
    RaycastRenderer,
    Scene,
    draw_overlay,
    draw_still,
    pose_in_view,
    visible_keypoints,
)
from cadalign.render.drawing.canvas import ByteImage, composite

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
MODELS = (("chair", "000"), ("car", "002"), ("bottle", "002"), ("vessel", "003"))
COLORS = {"x": "#c62828", "y": "#2e7d32", "z": "#1565c0"}
WIDTH, ROW, TOP = 1080, 34, 56
CHAIR_CAMERA = Camera.from_fov(640, 720, fov_x=33.0)
CHAIR_VIEW = Angles(azimuth=143.0, elevation=24.0)
PHOTO_GROUND = (206, 208, 212)
LINE = (35, 208, 255)
# Layers by kind, and the kind's colour.
KINDS = {
    "#e8e8ec": "errors names arrays compile",
    "#d9e8f7": "geometry metrics io solvers shapes export estimation torch",
    "#dcf0dc": "datasets render web",
    "#fbe9d0": "retrieval evaluation batch report annotate cli scripts",
}
# The layers that a journey passes, in order, and what happens there.
FIT = "cli options, io observation, estimation checks, solvers search, render overlay"
INSTANCE = (
    "cli options, evaluation task, datasets model, render visible keypoints, estimation fit, "
    "solvers search, geometry errors, report page"
)


def overview(*, out: Path = DOCS / "overview.png", width: int = 1600) -> None:
    """Overlays of four sample models, side by side: the README's picture.

    Parameters
    ----------
    out : Path
        Where to write the picture.
    width : int
        Width in pixels.
    """
    with tempfile.TemporaryDirectory() as folder:
        dataset = KeypointNet(write_sample_dataset(Path(folder) / "sample"))
        pictures = [_overlay(dataset, *model) for model in MODELS]
    write_row(out, pictures, width=width)


def _overlay(dataset: KeypointNet, category: str, number: str) -> np.ndarray:
    model = dataset[category, f"sample_{category}_{number}"]
    instance = make_instance(
        model, noise_px=1.0, min_visible=6, seed=0, view_index=0, scene=load_scene(model)
    )
    result = fit(instance.points_3d, instance.points_2d, instance.camera)
    frame = RaycastRenderer().render(instance.scene, instance.camera, instance.cam_from_model)
    return draw_overlay(
        frame.composite(),
        instance.camera,
        gt_box=Box.from_model(instance.bounds, instance.gt),
        est_box=Box.from_model(instance.bounds, result.alignment),
        observed=instance.points_2d,
        reprojected=instance.camera.project(result.alignment.apply(instance.points_3d)),
        legend=category == "chair",
    )


def chairs(
    *,
    out: Path | None = None,
    photo_of: str = "006",
    model: str = "000",
    files: Path | None = None,
    width: int = 1500,
) -> None:
    """Align one sample chair to a photo of another: the README's worked example.

    The photo is a rendering of the one chair; keypoints are joined by their semantic ids.

    Parameters
    ----------
    out : Path, optional
        Where to write the picture; by default beside the files, or docs/other_chair.png.
    photo_of : str
        The sample chair in the photo.
    model : str
        The sample chair that is aligned to it.
    files : Path, optional
        Folder for the photo, the observation and the model's keypoints.
    width : int
        Width of the picture in pixels.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = files or Path(folder)
        dataset = KeypointNet(write_sample_dataset(root / "sample"))
        seen, own = (dataset["chair", f"sample_chair_{name}"] for name in (photo_of, model))
        photo = root / "photo.png"
        observation = observe(seen, own, photo)
        observation.save(root / "photo.json")
        ModelKeypoints.of_model(own).save(root / f"{own.model_id}.keypoints.json")
        result = fit(observation.points_3d, observation.points_2d, observation.camera, sigma=None)
        print(result)

        scene = Scene(own.load_mesh())
        image = read_image(photo, CHAIR_CAMERA)
        aligned = draw_overlay(
            with_wireframe(image, ClickableModel(scene.mesh), result.alignment),
            CHAIR_CAMERA,
            est_box=Box.from_model(scene.bounds, result.alignment),
            observed=observation.points_2d,
            reprojected=CHAIR_CAMERA.project(result.alignment.apply(observation.points_3d)),
            legend=False,
        )
        out = out or (Path("docs") if files is None else files) / "other_chair.png"
        write_row(out, [image, still(scene), aligned], width=width)


def observe(seen: AnnotatedModel, model: AnnotatedModel, photo: Path) -> Observation:
    """Render the photo; its visible keypoints, with the other model's points of the same ids."""
    scene = Scene(seen.load_mesh())
    pose = pose_in_view(scene, CHAIR_CAMERA, CHAIR_VIEW)
    write_image(photo, still(scene))
    visible = visible_keypoints(scene, seen.keypoints.xyz, CHAIR_CAMERA, pose)
    in_photo = seen.keypoints.xyz[visible]
    shared, rows, model_rows = np.intersect1d(
        seen.keypoints.ids[visible], model.keypoints.ids, return_indices=True
    )
    return Observation(
        points_3d=model.keypoints.xyz[model_rows],
        points_2d=CHAIR_CAMERA.project(pose.apply(in_photo[rows])),
        camera=CHAIR_CAMERA,
        ids=shared,
        image=photo,
        model=model.mesh_path,
        fit_options={"sigma": None},  # two chairs agree less well than pixels do
    )


def still(scene: Scene) -> ByteImage:
    """A picture of a chair, (h, w, 3) uint8."""
    pose = pose_in_view(scene, CHAIR_CAMERA, CHAIR_VIEW)
    color = draw_still(RaycastRenderer(), scene, CHAIR_CAMERA, pose, samples=16)
    return composite(color, PHOTO_GROUND)


def with_wireframe(image: ByteImage, model: ClickableModel, alignment: Alignment) -> ByteImage:
    """The photo with the lines of the stretched model."""
    drawn = image.copy()
    for start, end in Wireframe.of_model(model).seen_in(CHAIR_CAMERA, alignment):
        ends = [tuple(np.round(16 * point).astype(int).tolist()) for point in (start, end)]
        cv2.line(drawn, *ends, LINE, 1, cv2.LINE_AA, shift=4)
    return drawn


def write_row(path: Path, pictures: Sequence[np.ndarray], *, width: int) -> None:
    """Write pictures of one height side by side, shrunk to a width [px] in all."""
    row = np.hstack(pictures)
    height = round(row.shape[0] * width / row.shape[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, cv2.resize(row, (width, height), interpolation=cv2.INTER_AREA))


def annotator(*, out: Path = DOCS / "annotator.png", files: Path) -> None:
    """The annotator in a headless browser.

    Parameters
    ----------
    out : Path
        Where to write the picture.
    files : Path
        Where `chairs` has written its files.
    """
    sys.path.insert(0, str(ROOT / "tests"))
    from support.annotating import IDLE, opened_page, wait
    from support.chromium import chromium

    observation = files / "photo.json"
    model = Observation.load(observation).model
    options = SessionOptions(image=files / "photo.png", model=model, observation=observation)
    session = open_session(options)
    session.warm_up()
    with chromium() as browser, opened_page(browser, session, width=1280, height=960) as page:
        wait(page, f"{IDLE} && annotator.state.alignment.status === 'done'")
        page.keyboard.press("v")
        page.wait_for_timeout(1000)  # until everything is drawn
        out.parent.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=out)


def axes_cross(ax: Axes, origin: tuple[float, float], ends: dict[str, tuple[float, float]]) -> None:
    """Three named arrows."""
    for name, (dx, dy) in ends.items():
        end = (origin[0] + dx, origin[1] + dy)
        ax.annotate(
            "", end, origin, arrowprops={"arrowstyle": "-|>", "color": COLORS[name], "lw": 2}
        )
        ax.text(origin[0] + 1.15 * dx, origin[1] + 1.15 * dy, name, color=COLORS[name],
                ha="center", va="center", fontsize=13, fontweight="bold")  # fmt: skip


def draw_scene(ax: Axes) -> None:
    """A camera that looks at a box, each with its axes."""
    axes_cross(ax, (0, 0), {"x": (0.55, -0.4), "y": (0, -0.9), "z": (1.5, 0.2)})
    ax.text(-0.1, 0.25, "camera", ha="right", fontsize=11)
    axes_cross(ax, (4.2, -1.1), {"x": (0.75, -0.2), "y": (0, 1.1), "z": (-0.6, -0.3)})
    ax.text(4.35, 0.25, "model", fontsize=11)
    ax.set(xlim=(-1, 5.5), ylim=(-1.9, 0.9), aspect="equal")


def draw_pixels(ax: Axes) -> None:
    """The corner of an image, with the coordinates of pixel centres."""
    for line in range(5):
        ax.plot([0, 4], [line, line], color="#9e9e9e", lw=1)
        ax.plot([line, line], [0, 4], color="#9e9e9e", lw=1)
    for column in range(4):
        ax.plot(column + 0.5, 0.5, "o", color="#424242", ms=4)
        ax.text(column + 0.5, 0.28, f"({column}, 0)", ha="center", va="center", fontsize=9)
    ax.plot(0, 0, "s", color="#c62828", ms=6, clip_on=False)
    ax.text(
        0, -0.25, "corner: (-0.5, -0.5);\n(0, 0) in COLMAP and in JSON", color="#c62828", fontsize=9
    )
    ax.set(xlim=(-0.2, 4.4), ylim=(4.2, -0.9), aspect="equal")


def conventions() -> None:
    """Camera axes, the model's axes, and pixel centres; the same bytes every time."""
    matplotlib.rcParams["svg.hashsalt"] = "cadalign"
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 3.4), width_ratios=(6, 4), layout="constrained")
    draw_scene(axes[0])
    draw_pixels(axes[1])
    for ax in axes:
        ax.set_axis_off()
    figure.patch.set_facecolor("white")
    figure.savefig(DOCS / "concepts" / "conventions.svg", metadata={"Date": None})


def label(x: float, y: float, content: str, style: str = "") -> str:
    """One line of text."""
    return f'<text x="{x}" y="{y}" {style}>{escape(content)}</text>'


def journey(title: str, x: float, color: str, stops: str, rows: dict[str, float]) -> list[str]:
    """A vertical line with a dot in every layer that a journey passes, numbered in order."""
    heights = []
    parts = [label(x - 6, 26, title, f'font-weight="bold" fill="{color}"')]
    for number, stop in enumerate(stops.split(", "), start=1):
        name, note = stop.split(maxsplit=1)
        y = rows[name]
        heights.append(y)
        parts.append(f'<circle cx="{x}" cy="{y}" r="6" fill="{color}"/>')
        parts.append(label(x + 12, y + 4, f"{number} {note}"))
    line = f'<path d="M{x} {min(heights)}V{max(heights)}" stroke="{color}" stroke-width="3"/>'
    return [line, *parts]


def architecture() -> None:
    """The README's list of layers, the lowest at the bottom, and two journeys through them."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    listed = readme.split("## How it is built\n\n```\n")[1].split("```")[0]
    layers = re.findall(r"^ *([a-z]+)(?:\.py|/) +(.+)$", listed, re.MULTILINE)[::-1]
    rows = {name: TOP + ROW * k for k, (name, _) in enumerate(layers)}
    height = TOP + ROW * len(layers)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        'font-family="Helvetica, Arial, sans-serif" font-size="13" fill="#222">',
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
        label(20, 26, "A layer imports only what stands below it", 'font-weight="bold"'),
    ]
    for name, about in layers:
        color = next(color for color, names in KINDS.items() if name in names.split())
        box = f'x="20" y="{rows[name] - 14}" width="{WIDTH - 40}" height="28" rx="5"'
        parts.append(f'<rect {box} fill="{color}"/>')
        parts.append(label(32, rows[name] + 4, name, 'font-weight="bold" font-family="monospace"'))
        parts.append(label(132, rows[name] + 4, about))
    parts += journey("one fit", 760, "#0b63b5", FIT, rows)
    parts += journey("one evaluated instance", 910, "#b54708", INSTANCE, rows)
    picture = "\n".join([*parts, "</svg>\n"])
    (DOCS / "architecture.svg").write_text(picture, encoding="utf-8")


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {each.__name__: each for each in (overview, chairs, annotator, conventions, architecture)}
    )
