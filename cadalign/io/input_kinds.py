"""Kinds of inputs, one observation or many, and what a detector's file lacks.

A module that loads quickly: the command for a single observation asks it, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cadalign.errors import InputError

LINES = (".jsonl", ".ndjson")
"""Endings of files with an observation in every line."""
TABLE = ".csv"
OBSERVATION, DETECTOR, OTHER = "observation", "detector", "other"
_WILD = frozenset("*?[")
_MESHES = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
_PHOTOS = (".bmp", ".gif", ".heic", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """Complements of a detector's file of keypoints, and which of its keypoints count."""

    model: Path | None = None
    """Keypoints of the model, NAME.keypoints.json, that those of a detector's file are paired with:
    by name, otherwise by semantic id, otherwise by order. With --shape, the shape's by default. Of
    `fit --mask` without an observation, the model itself."""
    images: Path | None = None
    """Folder of the photos that a detector's file names."""
    min_score: float = 0.0
    """Least score of a detector's keypoint that is kept."""
    ignore_unknown: bool = False
    """Leave out a detector's keypoints that the model does not have."""


def is_of_many(path: Path, data: object = None) -> bool:
    """True for an input that may hold many observations; ``data`` is the content of a JSON file."""
    if path.is_dir() or path.suffix.lower() in (*LINES, TABLE):
        return True
    return kind_of(data) == DETECTOR or is_pattern(path)


def is_pattern(path: Path) -> bool:
    """True for what matches files, and is none."""
    return not _WILD.isdisjoint(str(path)) and not path.exists()


def kind_of(data: object) -> str:
    """Kind of a JSON file, by its content."""
    if isinstance(data, list):
        return DETECTOR
    if not isinstance(data, dict):
        return OTHER
    if {"annotations", "instance_info"} & set(data):
        return DETECTOR
    is_meant = "views" in data or ("keypoints" in data and "format" not in data)
    return OBSERVATION if is_meant else OTHER


def refuse_photo_or_mesh(path: Path) -> None:
    """Refuse an image or a mesh in the place of an observation, and say what makes one."""
    if path.suffix.lower() in _MESHES:
        raise InputError(
            "a mesh, not an observation, which is a JSON file with camera and keypoints",
            where=str(path),
            fix=f"mark keypoints with `cadalign annotate PHOTO {path.name}`, which writes one",
        )
    if path.suffix.lower() in _PHOTOS:
        raise InputError(
            "a photo, not an observation, which is a JSON file with camera and keypoints",
            where=str(path),
            fix=f"mark keypoints with `cadalign annotate {path.name} MODEL`, which writes one, or "
            "use a detector's with `cadalign observe`",
        )
