"""The object's keypoints in its photos as COCO keypoint annotations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.export.aligned_object import AlignedObject
from cadalign.io.files import write_json

_OUTSIDE, _INFERRED, _OBSERVED = 0, 1, 2


def write_coco(path: Path, exported: AlignedObject) -> None:
    """Write all keypoints of the aligned object, projected, as an annotation of each photo.

    The visibility flag is 2 for keypoints that were observed, 1 for those that the alignment adds,
    and 0, with the coordinates 0, for those outside the image. ``bbox`` is that of the mesh,
    or else of the keypoints, in the image.
    """
    names = [str(each) for each in exported.ids]
    category = {"id": 1, "name": exported.name, "keypoints": names, "skeleton": []}
    numbers = range(len(exported.views))
    write_json(
        path,
        {
            "images": [_image(exported, number) for number in numbers],
            "categories": [category],
            "annotations": [_annotation(exported, number) for number in numbers],
        },
    )


def _image(exported: AlignedObject, number: int) -> dict[str, Any]:
    view = exported.views[number]
    size = {"width": view.camera.width, "height": view.camera.height}
    return {"id": number, "file_name": view.image_name or f"{number}.png", **size}


def _annotation(exported: AlignedObject, number: int) -> dict[str, Any]:
    view = exported.views[number]
    pixels = view.camera.project_where_ahead(view.cam_from_model.apply(exported.points_3d))
    inside: BoolArray = np.asarray(np.isfinite(pixels).all(axis=1))
    inside[inside] = view.camera.contains(pixels[inside])
    observed = np.isin([str(each) for each in exported.ids], [str(each) for each in view.ids])
    flags = np.where(inside, np.where(observed, _OBSERVED, _INFERRED), _OUTSIDE)
    rows = np.column_stack([np.where(inside[:, None], pixels, 0.0), flags])
    left, top, width, height = _rectangle(exported, number)
    return {
        "id": number + 1,
        "image_id": number,
        "category_id": 1,
        "keypoints": [
            value for x, y, flag in rows.tolist() for value in (round(x, 4), round(y, 4), int(flag))
        ],
        "num_keypoints": int(inside.sum()),
        "bbox": [left, top, width, height],
        "area": width * height,
        "iscrowd": 0,
    }


def _rectangle(exported: AlignedObject, number: int) -> tuple[float, float, float, float]:
    """Left, top, width and height of the object in the image [px], from its border."""
    view = exported.views[number]
    points = exported.points_3d if exported.mesh is None else exported.mesh.vertices
    in_camera = view.cam_from_model.apply(points)
    pixels = view.camera.project_where_ahead(in_camera)
    pixels = pixels[np.isfinite(pixels).all(axis=1)] + 0.5
    if not len(pixels):
        return 0.0, 0.0, 0.0, 0.0
    size = [view.camera.width, view.camera.height]
    left, top = np.clip(pixels.min(axis=0), 0, size).tolist()
    right, bottom = np.clip(pixels.max(axis=0), 0, size).tolist()
    return left, top, right - left, bottom - top
