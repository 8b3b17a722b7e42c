"""KeypointNet's annotation files, read model by model so that one bad model spoils no other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta

from cadalign.arrays import read_only
from cadalign.datasets.models.keypoints import Circle, Keypoints, RotationalSymmetry, Symmetries
from cadalign.errors import DataError, InputError, quote
from cadalign.geometry.mesh import GREY
from cadalign.io.documents import (
    Count,
    ForeignDocument,
    Id,
    NotNegative,
    Point3,
    convert,
    read_json,
)
from cadalign.io.files import damaged

_FIX = "repair or remove this model's annotation"
# Real barycentric coordinates sum to 0.999 ... 1.001.
_SUM_TOLERANCE = 0.01
_NO_POINT = -1


class _MeshInfo(ForeignDocument):
    """Place on the mesh: a face and the weights of its corners."""

    face_index: Count
    face_uv: Point3

    def __post_init__(self) -> None:
        total = sum(self.face_uv)
        if not abs(total - 1) <= _SUM_TOLERANCE:
            what = f"barycentric coordinates {list(self.face_uv)} sum to {total:g}, not to 1"
            raise InputError(what, where="face_uv")


class _CloudInfo(ForeignDocument):
    """Nearest point of the point cloud."""

    point_index: Count


class _Keypoint(ForeignDocument):
    xyz: Point3
    semantic_id: Count
    mesh_info: _MeshInfo
    pcd_info: _CloudInfo | None = None
    rgb: Point3 | None = None  # 0 to 255


class _Circle(ForeignDocument):
    center: Point3
    radius: NotNegative
    normal: Point3

    def __post_init__(self) -> None:
        if not any(self.normal):
            raise InputError("has no length", where="normal")


class _Reflection(ForeignDocument):
    kp_indexes: list[Count]  # rows of the keypoints

    def __post_init__(self) -> None:
        if len(self.kp_indexes) != 2:
            what = f"{len(self.kp_indexes)} keypoints do not mirror each other, two do"
            raise InputError(what, where="kp_indexes")


class _Rotation(ForeignDocument):
    kp_indexes: list[Count]
    is_circle: bool
    circle: Any = None  # a _Circle if is_circle, else anything


class _Symmetries(ForeignDocument):
    reflection: list[_Reflection]
    rotation: list[_Rotation]


class _Entry(ForeignDocument):
    """One model's object in an annotation file."""

    class_id: Id
    model_id: Id
    keypoints: Annotated[list[_Keypoint], Meta(min_length=1)]
    symmetries: _Symmetries | None = None

    def __post_init__(self) -> None:
        require_unique(self.keypoints, "semantic_id")
        for kind in ("reflection", "rotation"):
            for position, item in enumerate(getattr(self.symmetries, kind, ())):
                beyond = [row for row in item.kp_indexes if row >= len(self.keypoints)]
                if beyond:
                    raise InputError(
                        f"{beyond[0]} is not the row of one of the {len(self.keypoints)} keypoints",
                        where=f"symmetries.{kind}[{position}].kp_indexes",
                    )


def require_unique(keypoints: Sequence[Any], field: str) -> None:
    """Refuse a field's value, other than None, that two of the keypoints have."""
    first: dict[Any, int] = {}
    for row, keypoint in enumerate(keypoints):
        value = getattr(keypoint, field)
        if value is not None and first.setdefault(value, row) != row:
            what = f"{value!r} occurs twice, first in keypoints[{first[value]}]"
            raise InputError(what, where=f"keypoints[{row}].{field}")


class Annotation(NamedTuple):
    """One model's entry of an annotation file."""

    class_id: str
    model_id: str
    keypoints: Keypoints
    symmetries: Symmetries


def read_entries(path: Path) -> list[Any]:
    """Read an annotation file's list of models, not yet checked."""
    try:
        entries = read_json(path)
    except DataError as error:
        raise damaged(error.what, error.where) from None
    if not isinstance(entries, list):
        raise DataError(
            f"{quote(entries)} is not a list of models",
            where=str(path),
            fix="is it one of KeypointNet's annotation files?",
        )
    return entries


def entry_id(entry: Any, position: int) -> str:
    """An entry's model id, or ``#position`` where it has none."""
    model_id = entry.get("model_id") if isinstance(entry, dict) else None
    return model_id if isinstance(model_id, str) and model_id else f"#{position}"


def parse_entry(entry: Any, *, where: str) -> Annotation:
    """Check a model's entry, parsed JSON; ``where`` is file and model id, for messages."""
    try:
        read: _Entry = convert(entry, _Entry)
        symmetries = Symmetries() if read.symmetries is None else _symmetries(read.symmetries)
    except DataError as error:
        place = f"{where}, {error.where}" if error.where else where
        raise DataError(error.what, where=place, fix=_FIX) from None
    return Annotation(read.class_id, read.model_id, _keypoints(read.keypoints), symmetries)


def _keypoints(entries: list[_Keypoint]) -> Keypoints:
    weights = np.array([entry.mesh_info.face_uv for entry in entries])
    grey = tuple(255 * value for value in GREY[:3])
    colors = np.array([entry.rgb or grey for entry in entries]) / 255
    return Keypoints(
        xyz=_frozen([entry.xyz for entry in entries]),
        semantic_ids=_frozen([entry.semantic_id for entry in entries]),
        face_index=_frozen([entry.mesh_info.face_index for entry in entries]),
        barycentric=_frozen(weights / weights.sum(axis=1, keepdims=True)),
        point_index=_frozen(
            [entry.pcd_info.point_index if entry.pcd_info else _NO_POINT for entry in entries]
        ),
        colors=_frozen(np.clip(colors, 0.0, 1.0)),
    )


def _symmetries(read: _Symmetries) -> Symmetries:
    rotations = []
    for row, item in enumerate(read.rotation):
        where = f"symmetries.rotation[{row}].circle"
        circle = _circle(convert(item.circle, _Circle, where=where)) if item.is_circle else None
        rotations.append(RotationalSymmetry(keypoints=tuple(item.kp_indexes), circle=circle))
    return Symmetries(
        reflections=tuple((item.kp_indexes[0], item.kp_indexes[1]) for item in read.reflection),
        rotations=tuple(rotations),
    )


def _circle(read: _Circle) -> Circle:
    normal = np.array(read.normal)
    normal /= np.abs(normal).max()  # whose square is finite
    return Circle(
        center=_frozen(read.center),
        radius=read.radius,
        normal=_frozen(normal / np.linalg.norm(normal)),
    )


def _frozen(values: Any) -> Any:
    return read_only(np.array(values))
