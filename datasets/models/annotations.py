"""KeypointNet's annotation files, read model by model so that one bad model spoils no other."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.datasets.models.keypoints import Circle, Keypoints, RotationalSymmetry, Symmetries
from cadalign.errors import DataError
from cadalign.geometry.mesh import GREY

_FIX = "repair or remove this model's annotation"
# Real barycentric coordinates sum to 0.999 ... 1.001.
_SUM_TOLERANCE = 0.01
_NO_POINT = -1
_NUMBER_TYPES = frozenset((int, float))


@dataclass(frozen=True, eq=False)
class Annotation:
    """One model's entry of an annotation file."""

    class_id: str
    model_id: str
    keypoints: Keypoints
    symmetries: Symmetries


def read_entries(path: Path) -> list[Any]:
    """Read an annotation file's list of models, not yet checked.

    Raises
    ------
    DataError
        If it cannot be read, is not JSON, or is not a list; names the line.
    """
    try:
        entries = json.loads(path.read_bytes())
    except OSError as error:
        raise DataError(
            f"the annotation file cannot be read ({error.strerror or error})", where=str(path)
        ) from None
    except json.JSONDecodeError as error:
        raise DataError(
            f"not JSON: {error.msg}",
            where=f"{path}, line {error.lineno}",
            fix="the file is cut short or damaged; get it again",
        ) from None
    except (UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"not JSON: {error}", where=str(path), fix="get it again") from None
    if not isinstance(entries, list):
        raise DataError(
            f"holds a JSON {_json_type(entries)}, not a list of models",
            where=str(path),
            fix="is it one of KeypointNet's annotation files?",
        )
    return entries


def entry_id(entry: Any, position: int) -> str:
    """An entry's model id, or ``#position`` where it has none."""
    model_id = entry.get("model_id") if isinstance(entry, dict) else None
    return model_id if isinstance(model_id, str) and model_id else f"#{position}"


def parse_entry(entry: Any, *, where: str) -> Annotation:
    """Check an entry of an annotation file.

    Parameters
    ----------
    entry : object
        What the JSON file holds for the model.
    where : str
        File and model id, for messages.

    Raises
    ------
    DataError
        If a field is missing, of the wrong type or not finite, if there are no keypoints, or a
        semantic id occurs twice.
    """
    keypoints = _parse_keypoints(_field(entry, "keypoints", where), where)
    return Annotation(
        class_id=_string(entry, "class_id", where),
        model_id=_string(entry, "model_id", where),
        keypoints=keypoints,
        symmetries=_parse_symmetries(entry.get("symmetries"), len(keypoints), where),
    )


def _parse_keypoints(entries: Any, where: str) -> Keypoints:
    if not isinstance(entries, list):
        raise _wrong(entries, "a list", f"{where}, keypoints")
    if not entries:
        raise DataError("there are no keypoints", where=f"{where}, keypoints", fix=_FIX)
    rows = [_parse_keypoint(e, f"{where}, keypoints[{row}]") for row, e in enumerate(entries)]
    xyz, semantic_ids, faces, weights, points, colors = zip(*rows, strict=True)
    first_row: dict[int, int] = {}
    for row, semantic_id in enumerate(semantic_ids):
        if first_row.setdefault(semantic_id, row) != row:
            raise DataError(
                f"{semantic_id} occurs twice, first in keypoints[{first_row[semantic_id]}]",
                where=f"{where}, keypoints[{row}].semantic_id",
                fix=_FIX,
            )
    return Keypoints(
        xyz=_frozen(xyz, float),
        semantic_ids=_frozen(semantic_ids, np.int64),
        face_index=_frozen(faces, np.int64),
        barycentric=_frozen(weights, float),
        point_index=_frozen(points, np.int64),
        colors=_frozen(colors, float),
    )


def _parse_keypoint(
    entry: Any, where: str
) -> tuple[list[float], int, int, list[float], int, list[float]]:
    mesh_info = _field(entry, "mesh_info", where)
    where_mesh = f"{where}.mesh_info"
    weights = _numbers(mesh_info, "face_uv", 3, where_mesh)
    total = sum(weights)
    if abs(total - 1) > _SUM_TOLERANCE:
        raise DataError(
            f"barycentric coordinates {weights} sum to {total:g}, not to 1",
            where=f"{where_mesh}.face_uv",
            fix=_FIX,
        )
    color = [255 * grey for grey in GREY[:3]]
    if entry.get("rgb") is not None:
        color = _numbers(entry, "rgb", 3, where)
    point_index = _NO_POINT
    if entry.get("pcd_info") is not None:
        point_index = _index(entry["pcd_info"], "point_index", f"{where}.pcd_info")
    return (
        _numbers(entry, "xyz", 3, where),
        _index(entry, "semantic_id", where),
        _index(mesh_info, "face_index", where_mesh),
        [weight / total for weight in weights],
        point_index,
        [min(max(value / 255, 0.0), 1.0) for value in color],
    )


def _parse_symmetries(entry: Any, count: int, where: str) -> Symmetries:
    if entry is None:
        return Symmetries()
    where = f"{where}, symmetries"
    reflections = []
    for row, item in enumerate(_list(entry, "reflection", where)):
        item_where = f"{where}.reflection[{row}]"
        rows = _keypoint_rows(item, count, item_where)
        if len(rows) != 2:
            raise DataError(
                f"{len(rows)} keypoints do not mirror each other, two do",
                where=f"{item_where}.kp_indexes",
                fix=_FIX,
            )
        reflections.append((rows[0], rows[1]))
    rotations = []
    for row, item in enumerate(_list(entry, "rotation", where)):
        item_where = f"{where}.rotation[{row}]"
        rows = _keypoint_rows(item, count, item_where)
        is_circle = _field(item, "is_circle", item_where)
        if not isinstance(is_circle, bool):
            raise _wrong(is_circle, "true or false", f"{item_where}.is_circle")
        circle = _parse_circle(item, item_where) if is_circle else None
        rotations.append(RotationalSymmetry(keypoints=rows, circle=circle))
    return Symmetries(reflections=tuple(reflections), rotations=tuple(rotations))


def _parse_circle(entry: Any, where: str) -> Circle:
    circle = _field(entry, "circle", where)
    where = f"{where}.circle"
    normal = np.array(_numbers(circle, "normal", 3, where))
    length = float(np.linalg.norm(normal))
    radius = _field(circle, "radius", where)
    if not _are_finite([radius]) or radius < 0:
        raise _wrong(radius, "a radius", f"{where}.radius")
    if length == 0:
        raise DataError("has no length", where=f"{where}.normal", fix=_FIX)
    return Circle(
        center=_frozen(_numbers(circle, "center", 3, where), float),
        radius=float(radius),
        normal=_frozen(normal / length, float),
    )


def _keypoint_rows(entry: Any, count: int, where: str) -> tuple[int, ...]:
    rows = _list(entry, "kp_indexes", where)
    for row in rows:
        if not _is_index(row) or row >= count:
            raise DataError(
                f"{row!r} is not the row of one of the {count} keypoints",
                where=f"{where}.kp_indexes",
                fix=_FIX,
            )
    return tuple(rows)


def _field(entry: Any, name: str, where: str) -> Any:
    if not isinstance(entry, dict):
        raise _wrong(entry, "an object", where)
    if name not in entry:
        raise DataError(f"the field {name!r} is missing", where=where, fix=_FIX)
    return entry[name]


def _list(entry: Any, name: str, where: str) -> list[Any]:
    value = _field(entry, name, where)
    if not isinstance(value, list):
        raise _wrong(value, "a list", f"{where}.{name}")
    return value


def _string(entry: Any, name: str, where: str) -> str:
    value = _field(entry, name, where)
    # These become parts of file paths, so they must not lead out of the dataset.
    if not isinstance(value, str) or not value or value in (".", "..") or set(value) & set("/\\\0"):
        raise _wrong(value, "an id", f"{where}, {name}")
    return value


def _numbers(entry: Any, name: str, count: int, where: str) -> list[float]:
    value = _field(entry, name, where)
    if not isinstance(value, list) or len(value) != count or not _are_finite(value):
        raise _wrong(value, f"{count} finite numbers", f"{where}.{name}")
    return value


def _index(entry: Any, name: str, where: str) -> int:
    value = _field(entry, name, where)
    if not _is_index(value):
        raise _wrong(value, "a number counted from 0", f"{where}.{name}")
    return int(value)


def _are_finite(values: list[Any]) -> bool:
    # By exact type, since JSON gives no other, and True is an int to isinstance.
    if not _NUMBER_TYPES.issuperset(map(type, values)):
        return False
    try:
        return math.isfinite(sum(values))
    except OverflowError:  # an integer beyond the floats
        return False


def _is_index(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _wrong(value: Any, wanted: str, where: str) -> DataError:
    shown = repr(value)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    return DataError(f"{shown} is not {wanted}", where=where, fix=_FIX)


def _json_type(value: Any) -> str:
    names = {dict: "object", str: "string", bool: "boolean", type(None): "null"}
    return names.get(type(value), "number")


def _frozen(values: Any, dtype: Any) -> Any:
    array = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array
