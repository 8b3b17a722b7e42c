"""`cadalign demo --files`: the files of the README's example, to try the commands with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.cli.common import make_folder, say

NAMES = ("front left", "front right", "back right", "back left", "top right", "top left", "rest")
KEYPOINTS = (
    *((-0.2, 0.0, 0.2), (0.2, 0.0, 0.2), (0.2, 0.1, -0.2), (-0.2, 0.1, -0.2)),
    *((0.18, 0.5, -0.25), (-0.18, 0.55, -0.25), (0.0, 0.3, 0.1)),
)
FOUND = (
    *((233.8, 340.5), (346.7, 387.1), (407.7, 298.2), (294.3, 262.7)),
    *((416.0, 123.9), (308.3, 76.3), (302.1, 227.2)),
)
"""The keypoints in the photo [px], with 1 px of noise."""
_FEET = ((-0.2, -0.2, 0.2), (0.2, -0.2, 0.2), (0.2, -0.2, -0.2), (-0.2, -0.2, -0.2))
_FACES = (
    *((0, 1, 2), (0, 2, 3), (3, 2, 4), (3, 4, 5)),  # seat and back
    *((0, 7, 1), (1, 8, 2), (2, 9, 3), (3, 10, 0), (3, 0, 6)),  # legs and a rest
)
_TURN, _PLACE, _STRETCH = (-2.578, -0.193, 0.824), (0.0, 0.291, 2.735), (1.0, 1.3, 0.8)


def write_example(folder: Path) -> None:
    """Write the files of the README's example to a folder.

    They are chair.obj, chair.keypoints.json, photo.jpg, which shows another chair with a focal
    length of 935 px, and found.json, as a detector finds its keypoints.
    """
    from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
    from cadalign.geometry.alignment import Alignment
    from cadalign.geometry.camera import Camera
    from cadalign.geometry.mesh import Mesh
    from cadalign.geometry.rotations import rotation_from_vector
    from cadalign.io.files import write_json
    from cadalign.io.images import write_image
    from cadalign.io.meshes.files import write_obj_mesh
    from cadalign.render import RaycastRenderer, Scene

    make_folder(folder)
    mesh = Mesh(np.array(KEYPOINTS + _FEET), np.array(_FACES))
    write_obj_mesh(folder / "chair.obj", mesh)
    named = tuple(map(ModelKeypoint, NAMES, KEYPOINTS))
    ModelKeypoints(named, folder / "chair.obj").save(folder / "chair.keypoints.json")
    camera = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
    turn, place, stretch = map(np.array, (_TURN, _PLACE, _STRETCH))
    pose = Alignment(rotation_from_vector(turn), place, stretch)
    frame = RaycastRenderer().render(Scene(mesh), camera, pose)
    write_image(folder / "photo.jpg", frame.composite())
    flat = [number for u, v in FOUND for number in (u, v, 2)]
    found = {
        "images": [{"id": 1, "file_name": "photo.jpg", "width": 640, "height": 480}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "keypoints": flat}],
        "categories": [{"id": 1, "name": "chair", "keypoints": list(NAMES)}],
    }
    write_json(folder / "found.json", found)
    say(f"Written to {folder}: chair.obj, chair.keypoints.json, photo.jpg, found.json")
