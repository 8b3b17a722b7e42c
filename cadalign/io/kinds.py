"""Kinds of files: a reader that gets a file of another kind says what the file is."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

from cadalign.errors import CadalignError, DataError
from cadalign.io.files import open_input

PHOTO = "a photo"
IMAGE = "an image"
MESH = "a mesh"
OBSERVATION = "an observation"
DETECTOR = "a detector's keypoints"
MODEL_KEYPOINTS = "keypoints of a model"
FIT = "the result of a fit"
CAMERA = "a camera"
SHAPE = "a learned shape"
LIBRARY = "a library of models"

LINES = (".jsonl", ".ndjson")
"""Endings of files with an observation in every line."""
TABLE = ".csv"
MESH_ENDINGS = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
PHOTO_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")

_HEAD_BYTES = 1024
_MOST_BYTES = 2**26  # of a JSON file that is read to name its kind
_STARTS = {
    PHOTO: (b"\x89PNG", b"\xff\xd8\xff", b"GIF8", b"II*\0", b"MM\0*"),
    MESH: (b"glTF", b"ply\n", b"ply\r"),
    SHAPE: (b"cadalign shape",),
    LIBRARY: (b"cadalign library",),
}
MATRIX_NAMES = ("matrix", "K", "camera_matrix")
"""Names of a calibration matrix in a JSON file."""
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
    IMAGE: "give a picture, such as a PNG or a JPEG",
}


def kind_of(data: object) -> str | None:
    """Kind of the parsed form of a JSON file, by its fields; None where these tell none."""
    if isinstance(data, list):
        first = data[0] if data else None
        if isinstance(first, dict) and "model_id" in first:
            return MODEL_KEYPOINTS  # KeypointNet's annotations
        if isinstance(first, list | float | int):
            return CAMERA if len(data) in (3, 9) else None
        return None if isinstance(first, str) else DETECTOR
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
    if {"asset", "meshes"} <= fields:
        return MESH
    return CAMERA if {*MATRIX_NAMES, "params"} & fields and "width" in fields else None


def kind_of_file(path: Path) -> str | None:
    """Kind of a file, by its first bytes, its content as JSON, or else its ending."""
    suffix, is_there = path.suffix.lower(), False
    with suppress(CadalignError, ValueError, RecursionError), open_input(path) as file:
        is_there = True
        head = file.read(_HEAD_BYTES)
        for kind, starts in _STARTS.items():
            if head.startswith(starts):
                return kind
        is_text = head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"[")
        if is_text and file.size <= _MOST_BYTES and suffix not in LINES:
            file.seek(0)
            if (kind_found := kind_of(json.loads(file.read()))) is not None:
                return kind_found
    if is_there and suffix in MESH_ENDINGS:
        return MESH
    return PHOTO if is_there and suffix in (*PHOTO_ENDINGS, ".gif", ".heic") else None


def other_kind(path: Path, wanted: str, found: str | None) -> DataError | None:
    """The error of a file of a kind that is not wanted; None where its kind is not known."""
    if found in (None, wanted) or (found, wanted) == (PHOTO, IMAGE):
        return None
    fix = _FIXES.get(wanted)
    if wanted == OBSERVATION and found in (MESH, PHOTO):
        pair = f"PHOTO {path.name}" if found == MESH else f"{path.name} MODEL"
        fix = f"mark keypoints with `cadalign annotate {pair}`, which writes one"
        fix += ", or use a detector's with `cadalign observe`" if found == PHOTO else ""
    if wanted == OBSERVATION and found == FIT:
        fix = "give the observation that was fitted"
    if wanted == FIT and found == OBSERVATION:
        fix = f"fit it first, `cadalign fit {path.name}`, and give the fit.json that this writes"
    return DataError(f"{found}, not {wanted}", where=str(path), fix=fix)


def refuse_other_file(path: Path, wanted: str) -> None:
    """Raise a DataError for a file of another known kind than the wanted one."""
    if error := other_kind(path, wanted, kind_of_file(path)):
        raise error


def is_of_many(path: Path, data: object = None) -> bool:
    """True for an input that may hold many observations; ``data`` is the content of a JSON file."""
    is_container = os.path.isdir(path) or path.suffix.lower() in (*LINES, TABLE)
    return is_container or kind_of(data) == DETECTOR
