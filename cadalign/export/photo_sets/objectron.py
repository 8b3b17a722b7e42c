"""Objectron's form, as JSON: a box with nine degrees of freedom, its centre and corners.

The annotated camera is the sensor's, which lies on its side. The scene's y points up.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.export.photo_sets.annotated import AnnotatedPhoto
from cadalign.export.photo_sets.scan2cad import upright_rotation
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import PIXEL_CENTRE
from cadalign.io.files import write_json, writing

# The sign of z changes first, that of x last.
_UNIT_BOX = np.array(
    [[0, 0, 0], *([x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))],
    dtype=float,
)
# The sensor's y (up) is the photo's x (right), its x the photo's y (down); it looks along -z.
_CV_FROM_SENSOR = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_NEAR, _FAR = 1e-3, 1e3


def write_objectron(
    folder: Path, numbered: Iterable[tuple[int, AnnotatedPhoto]]
) -> list[InputError]:
    """Write the photos that the form can hold; returns why the others were left out."""
    problems = []
    for number, photo in numbered:
        place = folder / "annotations" / photo.category / "batch-1"
        try:
            sequence = _sequence(photo)
        except InputError as error:
            problems.append(error)
            continue
        with writing(place):
            place.mkdir(parents=True, exist_ok=True)
        write_json(place / f"{number}.json", sequence)
        photo.copy_image(place / f"{number}" / "0")
    return problems


def _sequence(photo: AnnotatedPhoto) -> dict[str, Any]:
    photo.require_plain_camera("Objectron")
    pose, camera = photo.pose, photo.camera
    sides = np.ptp(photo.bounds, axis=0)
    if not sides.min() > 0:
        raise InputError("the model is flat, which no box is", where=photo.image.name)
    center = pose.apply(photo.bounds.mean(axis=0)[None])[0]
    corners = center + (_UNIT_BOX * sides) @ pose.rotation.T
    share = (camera.project_where_ahead(corners) + PIXEL_CENTRE) / (camera.width, camera.height)
    if not np.isfinite(share).all():
        raise InputError("the box reaches behind the camera", where=photo.image.name)
    world_from_cam = _Y_UP_FROM_Z_UP @ upright_rotation(photo.upwards)
    view = np.eye(4)
    view[:3, :3] = _CV_FROM_SENSOR.T @ world_from_cam.T
    found = {
        "id": 1,
        "category": photo.category,
        "rotation": (world_from_cam @ pose.rotation).ravel().tolist(),
        "translation": (world_from_cam @ center).tolist(),
        "scale": sides.tolist(),
    }
    keypoints = [
        {"id": k, "point2d": {"x": x, "y": y, "depth": depth}}
        for k, ((x, y), depth) in enumerate(
            zip(share.tolist(), corners[:, 2].tolist(), strict=True)
        )
    ]
    frame = {
        "frameId": 0,
        "annotations": [{"objectId": 1, "keypoints": keypoints, "visibility": 1.0}],
        "camera": {
            "imageResolutionWidth": camera.height,
            "imageResolutionHeight": camera.width,
            "projectionMatrix": _projection(camera).ravel().tolist(),
            "viewMatrix": view.ravel().tolist(),
        },
    }
    return {"objects": [found], "frameAnnotations": [frame]}


def _projection(camera: Camera) -> FloatArray:
    """The projection matrix of the sensor on its side."""
    width, height = camera.width, camera.height
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 2 * camera.fy / height, 2 * camera.fx / width
    matrix[0, 2] = 1 - 2 * (camera.cy + PIXEL_CENTRE) / height
    matrix[1, 2] = 1 - 2 * (camera.cx + PIXEL_CENTRE) / width
    matrix[2, 2:] = -(_FAR + _NEAR) / (_FAR - _NEAR), -2 * _FAR * _NEAR / (_FAR - _NEAR)
    matrix[3, 2] = -1.0
    return matrix
