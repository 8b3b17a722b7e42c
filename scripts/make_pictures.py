"""Make the documentation's pictures: overview, annotator, conventions, architecture.

    python scripts/make_pictures.py overview

The annotator's photo and model are those of `align_other_chair.py`, whose files are needed:

    python scripts/align_other_chair.py --files chairs
    python scripts/make_pictures.py annotator --files chairs
"""

from __future__ import annotations

import re
import sys
import tempfile
from html import escape
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from align_other_chair import write_row
from matplotlib.axes import Axes

from cadalign import Box, Observation, fit
from cadalign.annotate.opening import open_session
from cadalign.annotate.options import SessionOptions
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.instances.instance import load_scene, make_instance
from cadalign.render import RaycastRenderer, draw_overlay

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
MODELS = (("chair", "000"), ("car", "002"), ("bottle", "002"), ("vessel", "003"))
COLORS = {"x": "#c62828", "y": "#2e7d32", "z": "#1565c0"}
WIDTH, ROW, TOP = 1080, 34, 56
# Layers by kind, and the kind's colour.
KINDS = {
    "#e8e8ec": "errors names arrays notebook seeding compile",
    "#d9e8f7": "geometry metrics io solvers shapes export estimation torch jax",
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


def annotator(*, out: Path = DOCS / "annotator.png", files: Path) -> None:
    """The annotator in a headless browser.

    Parameters
    ----------
    out : Path
        Where to write the picture.
    files : Path
        Where `align_other_chair.py` has written its files.
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
        {each.__name__: each for each in (overview, annotator, conventions, architecture)}
    )
