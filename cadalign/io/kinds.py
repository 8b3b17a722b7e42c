"""Recognise kinds of files, so that a reader can name the kind of a wrong file."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

from cadalign.errors import CadalignError, DataError
from cadalign.io.files import read_bytes

PHOTO = "a photo"
MESH = "a mesh"
OBSERVATION = "an observation"
DETECTOR = "a detector's keypoints"
MODEL_KEYPOINTS = "keypoints of a model"
FIT = "the result of a fit"
CAMERA = "a camera"

LINES = (".jsonl", ".ndjson")
"""Endings of files with one observation per line."""
TABLE = ".csv"
MESH_ENDINGS = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
PHOTO_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")

_MOST_BYTES = 2**26  # size limit of a JSON file that is read to find its kind
CAMERA_FIX = (
    "give 3 x 3 numbers, or a JSON file with model, width, height and params as COLMAP does"
)
_FIXES = {
    OBSERVATION: "give a JSON file with camera and keypoints, as `cadalign annotate PHOTO MODEL` "
    "and `cadalign observe` write it",
    DETECTOR: "give COCO's keypoint JSON, a detector's, or CSV",
    MODEL_KEYPOINTS: "give the model's NAME.keypoints.json",
    FIT: "give the fit.json that `cadalign fit` writes",
    CAMERA: CAMERA_FIX,
    MESH: f"give a file that ends in {', '.join(MESH_ENDINGS)}",
    PHOTO: "give a picture, such as a PNG or a JPEG",
}
_SPECIAL_FIXES = {
    (FIT, OBSERVATION): "give the observation that was fitted",
    (OBSERVATION, FIT): "fit it first, `cadalign fit {}`, and give the fit.json that this writes",
    (MESH, OBSERVATION): "mark keypoints with `cadalign annotate PHOTO {}`, which writes one",
    (PHOTO, OBSERVATION): "mark keypoints with `cadalign annotate {} MODEL`, which writes one, or "
    "use a detector's with `cadalign observe`",
}


def kind_of(data: object) -> str | None:
    """Find the kind of parsed JSON by its fields; None if it is unknown."""
    if isinstance(data, list):
        first = data[0] if data else {}
        if not isinstance(first, dict):
            return None
        return MODEL_KEYPOINTS if "model_id" in first else DETECTOR  # "model_id": KeypointNet
    if not isinstance(data, dict):
        return None
    fields = set(data)
    if "alignment" in fields:
        return FIT
    if "annotations" in fields:
        return DETECTOR
    if "keypoints" in fields and "camera" not in fields:
        points = data["keypoints"]
        first = points[0] if isinstance(points, list) and points else None
        if "format" in fields or (isinstance(first, dict) and "uv" not in first):
            return MODEL_KEYPOINTS
    if {"views", "keypoints"} & fields:
        return OBSERVATION
    return CAMERA if {"matrix", "params"} & fields and "width" in fields else None


def kind_of_file(path: Path) -> str | None:
    """Find the kind of an existing file by its ending, or by its content if it is JSON."""
    suffix, data = path.suffix.lower(), None
    if os.path.isfile(path) and suffix in (*MESH_ENDINGS, *PHOTO_ENDINGS):
        return MESH if suffix in MESH_ENDINGS else PHOTO
    if suffix == ".json":
        with suppress(CadalignError, ValueError, RecursionError):
            data = json.loads(read_bytes(path, most=_MOST_BYTES))
    return kind_of(data)


def refuse_other(wanted: str, found: str | None, path: Path | None = None) -> None:
    """Raise a DataError if the kind that was found is known and not the wanted kind."""
    if found in (None, wanted):
        return
    where, name = (None, "") if path is None else (str(path), path.name)
    special = _SPECIAL_FIXES.get((found, wanted))
    fix = _FIXES.get(wanted) if special is None else special.format(name)
    raise DataError(f"{found}, not {wanted}", where=where, fix=fix)


def refuse_other_file(path: Path, wanted: str) -> None:
    """Raise a DataError if a file's kind is known and not the wanted kind."""
    refuse_other(wanted, kind_of_file(path), path)


def is_of_many(path: Path, data: object = None) -> bool:
    """True if an input may hold several observations; ``data`` is the content of a JSON file."""
    is_container = os.path.isdir(path) or path.suffix.lower() in (*LINES, TABLE)
    return is_container or kind_of(data) == DETECTOR
