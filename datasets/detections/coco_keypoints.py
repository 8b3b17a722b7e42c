"""Keypoints in images from COCO's JSON and what detectors make of it.

Four forms are read:

COCO annotations
    ``{"images": [...], "annotations": [{"image_id", "category_id", "keypoints"}, ...],
    "categories": [{"id", "keypoints": [names]}]}``, ``keypoints`` a list x, y, v, x, y, v, ...
COCO results (MMPose's and Detectron2's result files, ultralytics' ``save_json``)
    ``[{"image_id", "category_id", "keypoints": [x, y, score, ...], "score"}, ...]``
MMPose predictions (``inferencer(..., pred_out_dir=...)``)
    ``[{"keypoints": [[x, y], ...], "keypoint_scores": [...]}, ...]``, alone or as ``instances`` in
    the ``instance_info`` of an object whose ``meta_info`` names the keypoints
ultralytics' ``results.to_json()``
    ``[{"confidence", "keypoints": {"x": [...], "y": [...], "visible": [...]}}, ...]``

The third number of a keypoint is its visibility flag where all of an object's are 0, 1 or 2 and one
is 2: 0 for not labelled, 1 for hidden, 2 for visible. Otherwise it is the detector's score. As in
COCO, integer coordinates are pixel centres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, as_floats
from cadalign.datasets.detections.image_keypoints import OCCLUDED_SCORE, ImageKeypoints
from cadalign.errors import DataError
from cadalign.io.json_file import as_number, as_object, as_text, in_file, read_json

_FIX = "is it COCO's keypoint JSON, or a detector's? see datasets/detections/coco_keypoints.py"


def read_coco_keypoints(path: Path) -> list[ImageKeypoints]:
    """Read any of the four forms, one entry for each object in each image.

    Raises
    ------
    DataError
        If it is missing, is not JSON or of another form, or a field is missing or invalid; names
        file and field.
    """
    data = read_json(path)
    with in_file(path):
        objects = _read(data)
    if not objects:
        raise DataError("there are no keypoints", where=str(path))
    return [replace(found, source=f"{path}: {found.source}") for found in objects]


def _read(data: Any) -> list[ImageKeypoints]:
    if isinstance(data, list):
        return [_detection(entry, f"[{row}]") for row, entry in enumerate(data)]
    data = as_object(data, where=None)
    if "annotations" in data:
        return _annotations(data)
    if "instance_info" in data:
        return _mmpose_predictions(data)
    raise DataError("neither annotations nor instance_info", where="top level", fix=_FIX)


def _annotations(data: Mapping[str, Any]) -> list[ImageKeypoints]:
    """COCO annotations."""
    images = {
        _key(image, "id", where): (image, where)
        for image, where in _entries(data, "images", required=False)
    }
    names = {
        _key(category, "id", where): _names(category.get("keypoints"), f"{where}.keypoints")
        for category, where in _entries(data, "categories", required=False)
    }
    objects = []
    for entry, where in _entries(data, "annotations"):
        if entry.get("num_keypoints") == 0:
            continue
        has_category = entry.get("category_id") is not None
        category = names.get(_key(entry, "category_id", where)) if has_category else None
        found = _detection(entry, where, names=category)
        if images:
            image_id = _key(entry, "image_id", where)
            if image_id not in images:
                raise DataError(f"there is no image {image_id!r}", where=f"{where}.image_id")
            found = replace(_in_image(found, *images[image_id]), images=len(images))
        objects.append(found)
    return objects


def _in_image(found: ImageKeypoints, image: Mapping[str, Any], where: str) -> ImageKeypoints:
    size = None
    if "width" in image and "height" in image:
        width, height = (as_number(image[n], where=f"{where}.{n}") for n in ("width", "height"))
        size = int(width), int(height)
    name = image.get("file_name")
    return replace(
        found,
        image=found.image if name is None else as_text(name, where=f"{where}.file_name"),
        size=size,
    )


def _mmpose_predictions(data: Mapping[str, Any]) -> list[ImageKeypoints]:
    """MMPose's file of predictions, with the keypoints' names in its ``meta_info``."""
    meta = as_object(data.get("meta_info", {}), where="meta_info")
    by_number = meta.get("keypoint_id2name")
    names = None
    if by_number is not None:
        by_number = as_object(by_number, where="meta_info.keypoint_id2name")
        listed = [by_number.get(str(number)) for number in range(len(by_number))]
        names = _names(listed, "meta_info.keypoint_id2name")
    objects = []
    for entry, where in _entries(data, "instance_info"):
        # One entry for each frame of a video, or the objects of the only image themselves.
        frame = entry.get("frame_id")
        instances = _entries(entry, "instances", within=where) if "instances" in entry else None
        for instance, place in [(entry, where)] if instances is None else instances:
            found = _detection(instance, place, names=names)
            objects.append(found if frame is None else replace(found, image=str(frame)))
    return objects


def _detection(entry: Any, where: str, *, names: tuple[str, ...] | None = None) -> ImageKeypoints:
    """One object of any form."""
    entry = as_object(entry, where=where)
    if "keypoints" not in entry:
        raise DataError("missing", where=f"{where}.keypoints", fix=_FIX)
    points, scores = _points(entry, f"{where}.keypoints")
    if names is not None and len(names) != len(points):
        raise DataError(
            f"{len(points)} keypoints, but the category names {len(names)}",
            where=f"{where}.keypoints",
        )
    score = next((entry[n] for n in ("score", "bbox_score", "confidence") if n in entry), None)
    image = entry.get("image_id")
    return ImageKeypoints(
        points_2d=points,
        scores=scores,
        names=names,
        image=None if image is None else str(image),
        score=None if score is None else as_number(score, where=f"{where}.score"),
        source=where,
    )


def _points(entry: Mapping[str, Any], where: str) -> tuple[FloatArray, FloatArray | None]:
    """Pixels (k, 2) and scores (k,) of one object."""
    value = entry["keypoints"]
    if isinstance(value, Mapping):
        for name in ("x", "y"):
            if name not in value:
                raise DataError("missing", where=f"{where}.{name}")
        x = as_floats(value["x"], name=f"{where}.x", shape=(None,))
        y = as_floats(value["y"], name=f"{where}.y", shape=(len(x),))
        third = value.get("visible")
        points = np.stack([x, y], axis=1)
        where = f"{where}.visible"
    else:
        rows = np.ndim(_as_list(value, where)[0]) > 0
        third = entry.get("keypoint_scores")
        if rows:
            numbers = as_floats(value, name=where, shape=(None, None))
        else:
            flat = as_floats(value, name=where, shape=(None,))
            if len(flat) % 3:
                raise DataError(
                    f"{len(flat)} numbers are not x, y and visibility of keypoints", where=where
                )
            numbers = flat.reshape(-1, 3)
        if numbers.shape[1] not in (2, 3):
            raise DataError(f"{numbers.shape[1]} numbers for a keypoint", where=where)
        points = np.ascontiguousarray(numbers[:, :2])
        if third is None and numbers.shape[1] == 3:
            third = numbers[:, 2]
    if third is None:
        return points, None
    return points, _scores(as_floats(third, name=where, shape=(len(points),)))


def _scores(third: FloatArray) -> FloatArray:
    """Scores, from visibility flags where they are that."""
    if np.isin(third, (0, 1, 2)).all() and (third == 2).any():
        return np.choose(third.astype(int), [0.0, OCCLUDED_SCORE, 1.0])
    return third


def _as_list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise DataError("expected a list of numbers", where=where)
    return value


def _entries(
    data: Mapping[str, Any], name: str, *, required: bool = True, within: str = ""
) -> list[tuple[Mapping[str, Any], str]]:
    """The objects of a list, each with its place."""
    place = f"{within}.{name}" if within else name
    values = data.get(name)
    if values is None and not required:
        return []
    if not isinstance(values, list):
        raise DataError("expected a list", where=place)
    return [
        (as_object(value, where=f"{place}[{row}]"), f"{place}[{row}]")
        for row, value in enumerate(values)
    ]


def _key(entry: Mapping[str, Any], name: str, where: str) -> str | int:
    value = entry.get(name)
    if not isinstance(value, str | int):
        raise DataError(
            "missing" if value is None else f"{value!r} is no id", where=f"{where}.{name}"
        )
    return value


def _names(value: Any, where: str) -> tuple[str, ...] | None:
    """A category's names of keypoints; None where it has none."""
    if value is None:
        return None
    if not isinstance(value, list):
        raise DataError("expected a list of names", where=where)
    names = tuple(as_text(name, where=f"{where}[{row}]") for row, name in enumerate(value))
    for row, name in enumerate(names):
        if name in names[:row]:
            raise DataError(f"{name!r} occurs twice", where=f"{where}[{row}]")
    return names
