"""Files of the README's example, of `cadalign demo --files`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.cli.common import say
from cadalign.datasets.model_keypoints import SUFFIX, ModelKeypoint, ModelKeypoints
from cadalign.datasets.sample import make_model
from cadalign.errors import DataError
from cadalign.geometry.camera import Camera
from cadalign.io.files import create_folder
from cadalign.io.images import write_image
from cadalign.io.meshes.files import write_mesh
from cadalign.io.observation import Observation
from cadalign.render import Angles, RaycastRenderer, Scene, pose_in_view, visible_keypoints
from cadalign.shapes.model import ShapeModel

CAMERA = Camera(640, 720, 1080.0, 1080.0, 319.5, 359.5)
VIEW = Angles(azimuth=143.0, elevation=24.0)
GROUND = (206, 208, 212)
"""Colour of the background."""
SEEN, OWN = 6, 0
"""Indices of the sample chairs: in the photo, and of the CAD model."""


def write_example(folder: Path) -> None:
    """Write the files of the README's example to a folder.

    The files are photo.jpg, chair.obj (a model of another chair), chair.keypoints.json (its
    keypoints by KeypointNet's names), and clicks.json (keypoints in the photo, 1 px of noise).
    Raises DataError if one of them exists.
    """
    create_folder(folder)
    for name in ("photo.jpg", "clicks.json", "chair.obj", f"chair{SUFFIX}"):
        if (folder / name).exists():
            raise DataError("exists already", where=str(folder / name), fix="give a new folder")
    shape = ShapeModel.pretrained("chair")
    names = dict(zip(shape.ids, shape.names, strict=True))
    scene, places = build_chair(SEEN)
    pose = pose_in_view(scene, CAMERA, VIEW)
    frame = RaycastRenderer().render(scene, CAMERA, pose, samples=16)
    write_image(folder / "photo.jpg", frame.composite(GROUND))
    model, own = build_chair(OWN)
    path = folder / "chair.obj"
    write_mesh(path, model.mesh, kind="obj")
    points = {key: ModelKeypoint(names[key], at, key) for key, at in own.items() if key in names}
    ModelKeypoints(tuple(points.values()), path).save(path.with_suffix(SUFFIX))

    visible = visible_keypoints(scene, np.array(list(places.values())), CAMERA, pose)
    seen = [key for key, is_visible in zip(places, visible, strict=True) if is_visible]
    both = [key for key in seen if key in points]
    pixels = CAMERA.project(pose.apply([places[key] for key in both]))
    noise = np.random.default_rng(0).normal(size=pixels.shape)
    Observation(
        points_3d=np.array([points[key].xyz for key in both]),
        points_2d=np.round(pixels + noise, 1),
        camera=CAMERA,
        names=tuple(points[key].name for key in both),
        image=folder / "photo.jpg",
        model=path,
    ).save(folder / "clicks.json")
    say(f"Written to {folder}: photo.jpg, clicks.json, {path.name}, {path.stem}{SUFFIX}")


def build_chair(index: int) -> tuple[Scene, dict[int, tuple[float, float, float]]]:
    """Build a chair of the sample data set; returns it and its keypoints by semantic id."""
    mesh, entry = make_model("chair", index)
    return Scene(mesh), {each["semantic_id"]: tuple(each["xyz"]) for each in entry["keypoints"]}
