"""Make the pictures of the documentation.

python scripts/make_pictures.py overview
python scripts/make_pictures.py chairs
python scripts/make_pictures.py concepts
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import tyro

from cadalign import Alignment, Box, Library, Observation, ShapeModel, View, align, fit
from cadalign.cli.example import CAMERA, GROUND, VIEW, write_example
from cadalign.datasets import AnnotatedModel, KeypointNet, write_sample_dataset
from cadalign.evaluation.instances.instance import load_scene, make_instance
from cadalign.io.images import read_image, write_image
from cadalign.io.meshes.files import load_mesh
from cadalign.io.pretrained import CATEGORIES
from cadalign.render import (
    Angles,
    RaycastRenderer,
    Scene,
    draw_overlay,
    overlay_model,
    pose_in_view,
    visible_keypoints,
)
from cadalign.render.canvas import ByteImage
from cadalign.render.overlay import draw_result
from cadalign.retrieval.folder import draw_match
from cadalign.shapes.warp import warp_mesh

DOCS = Path(__file__).resolve().parents[1] / "docs"
MODELS = (("chair", "000"), ("car", "002"), ("bottle", "002"), ("vessel", "003"))


def overview() -> None:
    """Make the README's picture: overlays of four sample models."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = KeypointNet(write_sample_dataset(Path(folder) / "sample"))
        pictures = [_overlay(dataset, *model) for model in MODELS]
    write_row(DOCS / "overview.png", pictures, width=1600)


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


def chairs() -> None:
    """Make the picture of the worked example: a sample chair aligned to a photo of another one."""
    with tempfile.TemporaryDirectory() as folder:
        write_example(Path(folder))
        observation = Observation.load(Path(folder, "clicks.json"))
        image, mesh = read_image(Path(folder, "photo.jpg"), CAMERA), load_mesh(observation.model)
    result = fit(observation.points_3d, observation.points_2d, CAMERA, sigma=None)
    aligned = draw_overlay(
        overlay_model(image, CAMERA, Scene(mesh), result.alignment),
        CAMERA,
        observed=observation.points_2d,
        reprojected=CAMERA.project(result.alignment.apply(observation.points_3d)),
        legend=False,
    )
    write_row(DOCS / "other_chair.png", [image, still(Scene(mesh)), aligned], width=1500)


def still(scene: Scene, view: Angles = VIEW) -> ByteImage:
    """Render a model, (h, w, 3) uint8."""
    pose = pose_in_view(scene, CAMERA, view)
    return RaycastRenderer().render(scene, CAMERA, pose, samples=16).composite(GROUND)


def concepts() -> None:
    """Make one picture for each page on concepts."""
    with tempfile.TemporaryDirectory() as folder:
        root = write_sample_dataset(Path(folder) / "sample", per_category=60)
        dataset = KeypointNet(root)
        pages = {
            "determined": _boxes_that_agree(dataset["chair", "sample_chair_000"]),
            "uncertainty": _regions(dataset),
            "symmetry": _equal_poses(dataset["bottle", "sample_bottle_002"]),
            "shape_models": _modes(dataset),
            "retrieval": _matches(dataset),
        }
        for name, pictures in pages.items():
            write_row(DOCS / "concepts" / f"{name}.png", pictures, width=1200)


def _boxes_that_agree(model: AnnotatedModel) -> list[ByteImage]:
    """True and estimated box from the front, where they agree, and from the side."""
    scene, xyz = Scene(model.load_mesh()), model.keypoints.xyz
    front = xyz[np.argsort(xyz[:, 2])[:4]]  # in one plane
    poses = [pose_in_view(scene, CAMERA, Angles(azimuth=a, elevation=4.0)) for a in (0, 70)]
    pixels = CAMERA.project(poses[0].apply(front))
    pixels += np.random.default_rng(3).normal(0, 1.5, pixels.shape)
    shallow = np.array([1.0, 1.0, 0.5])  # of a model half as deep as the object
    result = fit(front * shallow, pixels, CAMERA, stretch_sigma=0.3)
    turn = poses[1].rotation @ poses[0].rotation.T
    shift = poses[1].translation - turn @ poses[0].translation
    seen = Alignment(
        turn @ result.alignment.rotation,
        turn @ result.alignment.translation + shift,
        result.alignment.scale,
    )
    return [
        draw_overlay(
            RaycastRenderer().render(scene, CAMERA, true, samples=16).composite(GROUND),
            CAMERA,
            gt_box=Box.from_model(scene.bounds, true),
            est_box=Box.from_model(scene.bounds * shallow, estimate),
            observed=pixels if true is poses[0] else None,
            legend=False,
        )
        for true, estimate in zip(poses, (result.alignment, seen), strict=True)
    ]


def _view_of(model: AnnotatedModel, *, noise_px: float) -> tuple[ByteImage, View]:
    """A rendered photo of a chair, and its visible keypoints."""
    scene = Scene(model.load_mesh())
    pose = pose_in_view(scene, CAMERA, VIEW)
    visible = visible_keypoints(scene, model.keypoints.xyz, CAMERA, pose)
    pixels = CAMERA.project(pose.apply(model.keypoints.xyz[visible]))
    pixels += np.random.default_rng(0).normal(0, noise_px, pixels.shape)
    return still(scene), View(CAMERA, pixels, ids=model.keypoints.ids[visible], sigma=noise_px)


def _regions(dataset: KeypointNet) -> list[ByteImage]:
    """95 % regions of a learned shape's keypoints, from all visible keypoints and from four."""
    shape = ShapeModel.from_dataset(dataset, "chair", split="train")
    photo, view = _view_of(dataset.subset(split="test")["chair"][0], noise_px=2.0)
    few = View(CAMERA, view.pixels[:4], ids=view.keypoint_ids[:4], sigma=2.0)
    return [draw_result(photo, align(shape, each)) for each in (view, few)]


def _equal_poses(model: AnnotatedModel) -> list[ByteImage]:
    """A bottle at three rotations about its axis, with its box."""
    scene, pictures = Scene(model.load_mesh()), []
    for degrees in (0, 40, 90):
        view = Angles(azimuth=degrees, elevation=24.0)
        box = Box.from_model(scene.bounds, pose_in_view(scene, CAMERA, view))
        pictures.append(draw_overlay(still(scene, view), CAMERA, est_box=box, legend=False))
    return pictures


def _modes(dataset: KeypointNet) -> list[ByteImage]:
    """A chair warped by -3, 0 and 3 standard deviations of the second mode (the first is size)."""
    shape = ShapeModel.from_dataset(dataset, "chair", split="train")
    component, model = shape.components[0], dataset["chair", "sample_chair_000"]
    rows = [shape.ids.index(int(label)) for label in model.keypoints.ids]
    mesh = model.load_mesh()
    return [
        still(Scene(warp_mesh(mesh, model.keypoints.xyz, places[rows], bounds=places[-2:])))
        for places in (component.mean + factor * component.modes[1] for factor in (-3, 0, 3))
    ]


def _matches(dataset: KeypointNet) -> list[ByteImage]:
    """A photo of a chair, and overlays of the three best matches."""
    photo, view = _view_of(dataset["chair", "sample_chair_006"], noise_px=1.0)
    library = Library.from_models(dataset["chair"])
    matches = library.retrieve(view.pixels, view.keypoint_ids, CAMERA, top=3)
    return [photo, *(draw_match(photo, match) for match in matches)]


def categories() -> None:
    """Draw the mean keypoints of each shape that comes with the package, from two sides."""
    from matplotlib.figure import Figure

    for category in CATEGORIES:
        shape = ShapeModel.pretrained(category)
        figure = Figure(figsize=(14, 7), layout="constrained")
        for axes, side, azimuth in zip(
            figure.subplots(1, 2), ("front right", "back left"), (145.0, -35.0), strict=True
        ):
            turn = np.radians(azimuth)
            towards = np.array([0.85 * np.sin(turn), 0.53, 0.85 * np.cos(turn)])
            right = np.cross([0.0, 1.0, 0.0], towards)
            right /= np.linalg.norm(right)
            points = shape.mean[:-2] @ np.array([right, np.cross(towards, right)]).T
            for line in shape.lines:
                axes.plot(*points[list(line)].T, color="0.6", zorder=1)
            axes.scatter(*points.T, s=18, zorder=2)
            for label, name, place in zip(shape.ids, shape.names, points, strict=True):
                axes.annotate(f"{label} {name}", place, (4, 4), textcoords="offset points", size=8)
            axes.set_title(f"{category}, from the {side}")
            axes.set_aspect("equal")
            axes.margins(0.12)
            axes.axis("off")
        figure.savefig(DOCS / "concepts" / f"{category}.png", dpi=75)


def write_row(path: Path, pictures: Sequence[np.ndarray], *, width: int) -> None:
    """Write pictures of equal height side by side, scaled to a total width [px]."""
    row = np.hstack(pictures)
    height = round(row.shape[0] * width / row.shape[1])
    write_image(path, cv2.resize(row, (width, height), interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {each.__name__: each for each in (overview, chairs, concepts, categories)}
    )
