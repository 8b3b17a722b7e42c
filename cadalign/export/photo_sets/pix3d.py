"""Pix3D's form: ``pix3d.json`` with a rigid pose, a focal length, and the exact model.

It has no stretch: the model of a photo is the stretched mesh, in metres.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.errors import InputError
from cadalign.export.photo_sets.annotated import AnnotatedPhoto, converted
from cadalign.geometry.conventions import PIXEL_CENTRE
from cadalign.io.files import write_json, write_text

_SENSOR = 32.0  # width that focal lengths are for [mm]
_AXES = np.array([-1.0, -1.0, 1.0])  # Pix3D's camera has x to the left, y up and z forward
_NEAR_MIDDLE = 1.0  # farthest principal point from the image's middle [px]
_SAME_FOCAL = 1e-3
_UNMARKED = (-1.0, -1.0)


def write_pix3d(folder: Path, numbered: Iterable[tuple[int, AnnotatedPhoto]]) -> list[InputError]:
    """Write the photos that the form can hold; returns why the others were left out."""
    entries, problems = converted(numbered, partial(_entry, folder))
    write_json(folder / "pix3d.json", entries)
    return problems


def _entry(folder: Path, number: int, photo: AnnotatedPhoto) -> dict[str, Any]:
    camera = photo.camera
    photo.require_plain_camera("Pix3D")
    middle = (camera.width - 1) / 2, (camera.height - 1) / 2
    is_off = max(abs(camera.cx - middle[0]), abs(camera.cy - middle[1])) > _NEAR_MIDDLE
    if is_off or abs(camera.fy / camera.fx - 1) > _SAME_FOCAL:
        raise InputError(
            "Pix3D has the principal point in the image's middle, and square pixels",
            where=photo.image.name,
            fix="choose another form, such as bop",
        )
    model = folder / "model" / photo.category / f"{number:06d}"
    photo.write_model(model / "model.obj", is_stretched=True)
    lines = (" ".join(f"{value:.17g}" for value in row) for row in photo.points.tolist())
    write_text(model / "3d_keypoints.txt", "\n".join(lines) + "\n")
    image = photo.copy_image(folder / "img" / photo.category / f"{number:06d}")
    mask = photo.copy_mask(folder / "mask" / photo.category / f"{number:06d}.png")
    marked = photo.marked
    pixels = [
        (marked[name] + PIXEL_CENTRE).tolist() if name in marked else list(_UNMARKED)
        for name in photo.names
    ]

    def written(path: Path) -> str:
        return path.relative_to(folder).as_posix()

    return {
        "img": written(image),
        "category": photo.category,
        "img_size": [camera.width, camera.height],
        "2d_keypoints": [pixels],
        "mask": None if mask is None else written(mask),
        "model": written(model / "model.obj"),
        "3d_keypoints": written(model / "3d_keypoints.txt"),
        "rot_mat": (_AXES[:, None] * photo.pose.rotation).tolist(),
        "trans_mat": (_AXES * photo.pose.translation).tolist(),
        "focal_length": camera.fx / camera.width * _SENSOR,
        "bbox": (photo.bbox + PIXEL_CENTRE).tolist(),
        "truncated": False,
        "occluded": False,
        "slightly_occluded": False,
    }
