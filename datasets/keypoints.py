"""Keypoints and symmetries of a model, and their entries in KeypointNet's annotation files.

Each model's entry is parsed alone, so a malformed entry does not affect other models.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from cadalign.arrays import BoolArray, FloatArray, IntArray, read_only
from cadalign.errors import DataError, InputError
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import (
    Count,
    ForeignDocument,
    Id,
    Point3,
    convert,
    require_unique,
)

_FIX = "repair or remove this model's annotation"
# Real barycentric coordinates sum to 0.999 ... 1.001.
_SUM_TOLERANCE = 0.01
_TOLERANCE = 0.03  # accuracy of annotated keypoints [their extent]
_MOTION_TOLERANCE = 0.2  # the same [distance that the rotation moves the keypoint]
_NO_MOTION = 1e-12  # squared distance below which a keypoint does not move
_FOLDS = (2, 3, 4, 5, 6, 8)
_AXIS_TOLERANCE_DEG = 10.0
# Powers of these stay finite, also in single precision.
_Coordinate = Annotated[float, Meta(ge=-1e30, le=1e30)]
_Place = tuple[_Coordinate, _Coordinate, _Coordinate]


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The annotated points of a model, in the order of the annotation file."""

    xyz: FloatArray
    """(k, 3), positions [model units]."""
    ids: IntArray
    """(k,), semantic id of each keypoint within its category; no id occurs twice."""
    face_index: IntArray
    """(k,), the face that each keypoint lies on, numbered as in the mesh file."""
    barycentric: FloatArray
    """(k, 3), place on the face: weights of its corners in file order, with sum 1."""

    def __len__(self) -> int:
        return len(self.xyz)

    def __iter__(self) -> Iterator[tuple[int, FloatArray]]:
        """Iterate over the (id, position (3,)) of each keypoint."""
        return zip(self.ids.tolist(), self.xyz, strict=True)


class Circle(ForeignDocument, eq=False):
    """A circle of equivalent keypoints, such as a bottle's rim."""

    center: _Place
    """(3,), the centre [model units]."""
    radius: Annotated[float, Meta(ge=0, le=1e30)]
    """The radius [model units]."""
    normal: Point3
    """(3,), unit vector along the axis."""

    def __post_init__(self) -> None:
        if not any(self.normal):
            raise InputError("the vector has length 0", where="normal")
        axis = np.array(self.normal) / np.abs(self.normal).max()  # its square is finite
        x, y, z = (axis / np.linalg.norm(axis)).tolist()
        self.normal = x, y, z


@dataclass(frozen=True)
class RotationalSymmetry:
    """Keypoints that a rotation of the object permutes."""

    keypoints: tuple[int, ...]
    """Rows of the keypoints in `Keypoints` (not semantic ids)."""
    circle: Circle | None = None
    """The keypoints' circle, if the object is symmetric under any rotation about its axis. None if
    only some rotations are symmetries, as with the five feet of an office chair."""


@dataclass(frozen=True)
class Symmetries:
    """The annotated symmetries of a model's keypoints."""

    reflections: tuple[tuple[int, int], ...] = ()
    """Pairs of keypoints that a reflection exchanges, as rows in `Keypoints` (not semantic ids)."""
    rotations: tuple[RotationalSymmetry, ...] = ()
    """Groups of keypoints that a rotation permutes."""


# Annotation files -------------------------------------------------------------------------------


class _MeshInfo(ForeignDocument):
    face_index: Count
    face_uv: Point3

    def __post_init__(self) -> None:
        total = sum(self.face_uv)
        if not abs(total - 1) <= _SUM_TOLERANCE:
            what = f"barycentric coordinates {list(self.face_uv)} sum to {total:g}, not to 1"
            raise InputError(what, where="face_uv")


class _Keypoint(ForeignDocument):
    xyz: _Place
    semantic_id: Count
    mesh_info: _MeshInfo


class _Reflection(ForeignDocument):
    kp_indexes: tuple[Count, Count]  # rows of the keypoints


class _Rotation(ForeignDocument):
    kp_indexes: list[Count]
    is_circle: bool
    circle: Any = None  # a Circle if is_circle, else anything


class _Symmetries(ForeignDocument):
    reflection: list[_Reflection]
    rotation: list[_Rotation]


class _Entry(ForeignDocument):
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
                        f"there is no row {beyond[0]} of {len(self.keypoints)} keypoints",
                        where=f"symmetries.{kind}[{position}].kp_indexes",
                    )


def entry_id(entry: Any, position: int) -> str:
    """Return an entry's model id, or ``#position`` if it has none."""
    model_id = entry.get("model_id") if isinstance(entry, dict) else None
    return model_id if isinstance(model_id, str) and model_id else f"#{position}"


def parse_entry(entry: Any, *, where: str) -> tuple[str, str, Keypoints, Symmetries]:
    """Parse a model's entry: class id, model id, keypoints and symmetries.

    ``entry`` is parsed JSON; ``where`` names file and model in messages.
    """
    try:
        read: _Entry = convert(entry, _Entry)
        symmetries = Symmetries() if read.symmetries is None else _symmetries(read.symmetries)
    except DataError as error:
        place = f"{where}, {error.where}" if error.where else where
        raise DataError(error.what, where=place, fix=_FIX) from None
    return read.class_id, read.model_id, _keypoints(read.keypoints), symmetries


def _keypoints(entries: list[_Keypoint]) -> Keypoints:
    weights = np.array([entry.mesh_info.face_uv for entry in entries])
    return Keypoints(
        xyz=_freeze([entry.xyz for entry in entries]),
        ids=_freeze([entry.semantic_id for entry in entries]),
        face_index=_freeze([entry.mesh_info.face_index for entry in entries]),
        barycentric=_freeze(weights / weights.sum(axis=1, keepdims=True)),
    )


def _symmetries(read: _Symmetries) -> Symmetries:
    rotations = []
    for row, item in enumerate(read.rotation):
        circle = None
        if item.is_circle:
            circle = convert(item.circle, Circle, where=f"symmetries.rotation[{row}].circle")
        rotations.append(RotationalSymmetry(keypoints=tuple(item.kp_indexes), circle=circle))
    return Symmetries(tuple(item.kp_indexes for item in read.reflection), tuple(rotations))


def _freeze(values: Any) -> Any:
    return read_only(np.array(values))


def annotated_symmetry(xyz: FloatArray, symmetries: Symmetries) -> Symmetry:
    """Find the rotations that map a model with the keypoints (k, 3) onto itself.

    The axis of a circle (`RotationalSymmetry.circle`) is an axis of revolution if every keypoint
    lies on the axis or on an annotated circle about it. A handle or a spout rules this out.

    Without such an axis, candidates are rotations about the model's coordinate axes through the
    mean of the keypoints, by multiples of 180, 120, 90, 72, 60 or 45 degrees. A candidate is a
    symmetry if it maps every keypoint to an equivalent keypoint or to itself, within 3 % of the
    keypoints' extent, and moves at least one to another. Two keypoints are equivalent if they
    belong to one annotated rotation, or if two or more annotated reflections connect them. The
    five feet of an office chair do not make it symmetric: its back is not mapped onto itself.

    A single reflection gives no symmetry, because an alignment never mirrors a model. The product
    of two reflections is a rotation and is found.
    """
    if not symmetries.reflections and not symmetries.rotations:
        return Symmetry.none()
    tolerance = _TOLERANCE * float(np.linalg.norm(np.ptp(xyz, axis=0)))
    revolution = _axis_of_revolution(xyz, symmetries, tolerance)
    if revolution is not None:
        center, axis = revolution
        return Symmetry.around(axis, fold=None, offset=center)
    equivalent = _equivalence(len(xyz), symmetries)
    if equivalent.sum() == len(xyz):  # each only to itself, as with a single reflection
        return Symmetry.none()
    center, rotations = xyz.mean(axis=0), _candidate_rotations()
    kept = _find_symmetries(xyz - center, equivalent, rotations, tolerance)
    return Symmetry(center, rotations[kept])


def _find_symmetries(
    points: FloatArray, equivalent: BoolArray, rotations: FloatArray, tolerance: float
) -> BoolArray:
    """Find the rotations (g, 3, 3) that permute the centred points (k, 3); returns a mask (g,).

    A rotation maps each point to the nearest point that is ``equivalent`` (k, k) to it. Their gap
    must be within the tolerance, and within a share of the distance between the two points: on a
    thin model, a wrong angle can be within the tolerance. At least one point must move, and no two
    points may map to the same point.
    """
    rows = np.arange(len(points))
    squares = (points**2).sum(axis=1)
    lengths = squares[:, None] + squares
    # Rotations keep lengths, so squared distances follow from dot products.
    gaps = lengths - 2 * (points @ rotations.transpose(0, 2, 1)) @ points.T
    gaps = np.where(equivalent, gaps, np.inf)
    nearest = gaps.argmin(axis=2)
    gap, way = gaps.min(axis=2), (lengths - 2 * points @ points.T)[rows, nearest]
    is_near = (gap <= tolerance**2) & ((gap <= _MOTION_TOLERANCE**2 * way) | (way < _NO_MOTION))
    is_reached_once = (np.diff(np.sort(nearest, axis=1), axis=1) > 0).all(axis=1)
    moves = (nearest != rows).any(axis=1)
    return np.asarray(is_near.all(axis=1) & is_reached_once & moves)


def _axis_of_revolution(
    xyz: FloatArray, symmetries: Symmetries, tolerance: float
) -> tuple[FloatArray, FloatArray] | None:
    """Find the axis of revolution: a point on it and its direction, or None."""
    circles = [(r.keypoints, r.circle) for r in symmetries.rotations if r.circle is not None]
    if not circles:
        return None
    normals = np.array([c.normal for _, c in circles])
    cosines, cosine = normals @ normals[0], np.cos(np.radians(_AXIS_TOLERANCE_DEG))
    rows = np.flatnonzero(np.abs(cosines) > cosine)
    same = [circles[row] for row in rows]
    mean = np.sign(cosines[rows]) @ normals[rows]
    axis = mean / np.linalg.norm(mean)
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > cosine:  # ShapeNet's models are turned about their coordinate axes
        axis = np.eye(3)[nearest]
    center = np.mean([c.center for _, c in same], axis=0)

    def distance(points: FloatArray) -> FloatArray:
        offset = points - center
        return np.asarray(np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=-1))

    if (distance(np.array([c.center for _, c in same])) > tolerance).any():
        return None
    on_circle = np.zeros(len(xyz), dtype=bool)
    on_circle[[row for rows, _ in same for row in rows]] = True
    if not (on_circle | (distance(xyz) <= tolerance)).all():
        return None
    return center, axis


def _equivalence(count: int, symmetries: Symmetries) -> BoolArray:
    """Mask (k, k) of the pairs of keypoints that a rotation may map onto each other."""
    orbits = list(range(count))
    for first, second in symmetries.reflections:
        joined, left = orbits[first], orbits[second]
        orbits = [joined if orbit == left else orbit for orbit in orbits]
    labels = np.array(orbits)
    # A group of two is a single reflection, which is not a rotation.
    equivalent = (labels[:, None] == labels) & (np.bincount(labels, minlength=count)[labels] > 2)
    for rotation in symmetries.rotations:
        rows = np.array(rotation.keypoints, dtype=np.int64)
        equivalent[rows[:, None], rows] = True
    return np.asarray(equivalent | np.eye(count, dtype=bool))


@cache
def _candidate_rotations() -> FloatArray:
    """Rotations (g, 3, 3) about the coordinate axes, without the identity."""
    turns = sorted({k / fold for fold in _FOLDS for k in range(1, fold)})
    return np.array(
        [rotation_from_vector(2 * np.pi * t * axis) for axis in np.eye(3) for t in turns]
    )
