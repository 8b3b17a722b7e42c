"""KITTI's form: ``cars.json`` with boxes that stand upright before a level camera, and keypoints.

The car's frame has x to its left, y to its rear and z up. A model whose y is up is taken to face
-z, as ShapeNet's do; one whose z is up to face -y.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.export.photo_sets.annotated import AnnotatedPhoto, converted
from cadalign.io.files import write_json

_LEVEL = np.array([0.0, -1.0, 0.0])
_MOST_TILT = 10.0  # of the model's up from the camera's [degrees]
# The car's frame from a model whose y is up: left is -x, rear z, up y.
_CAR_FROM_Y_UP = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


def write_kitti(folder: Path, numbered: Iterable[tuple[int, AnnotatedPhoto]]) -> list[InputError]:
    """Write the photos that the form can hold; returns why the others were left out."""
    entries, problems = converted(numbered, partial(_entry, folder))
    write_json(folder / "cars.json", entries)
    return problems


def _entry(folder: Path, number: int, photo: AnnotatedPhoto) -> dict[str, Any]:
    photo.require_plain_camera("KITTI")
    pose = photo.pose
    is_z_up = (pose.rotation[:, 2] @ _LEVEL) > (pose.rotation[:, 1] @ _LEVEL)
    car_from_model = np.eye(3) if is_z_up else _CAR_FROM_Y_UP
    cam_from_car: FloatArray = pose.rotation @ car_from_model.T
    tilt = np.degrees(np.arccos(np.clip(cam_from_car[:, 2] @ _LEVEL, -1, 1)))
    if tilt > _MOST_TILT:
        raise InputError(
            f"KITTI's boxes stand upright, but this one is tilted by {tilt:.0f} degrees",
            where=photo.image.name,
            fix="choose another form, such as bop",
        )
    width, length, height = np.abs(car_from_model @ np.ptp(photo.bounds, axis=0)).tolist()
    center = pose.apply(photo.bounds.mean(axis=0)[None])[0]
    forward = -cam_from_car[:, 1]
    image = photo.copy_image(folder / "images" / f"{number:06d}")
    on_car = photo.points @ car_from_model.T
    keypoints = [
        {"name": name, "xyz": xyz.tolist(), "uv": photo.marked[name].tolist()}
        for name, xyz in zip(photo.names, on_car, strict=True)
        if name in photo.marked
    ]
    return {
        "image": image.relative_to(folder).as_posix(),
        "K": photo.camera.matrix.tolist(),
        "bbox": photo.bbox.tolist(),
        "dims_hwl": [height, width, length],
        "location_bottom_centre": (center + [0.0, height / 2, 0.0]).tolist(),
        "rotation_y": float(np.arctan2(-forward[2], forward[0])),
        "keypoints": keypoints,
    }
