"""Keypoints of the annotated model, and the kind of shape that its objects have."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.io.pretrained import category_of, shape_path
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import KeypointId

_LONGEST_NAME = 80


class KeypointRegistry:
    """Keypoints by semantic id; points can be added and renamed, but not moved or removed.

    New points do not get ``reserved`` ids. Points at most ``tolerance`` apart [model units] are the
    same point. The attribute ``file_ids`` holds the ids that were read from files. The keypoints of
    a learned shape are ``fixed``: they keep their names, and files add none.
    """

    def __init__(
        self, *, reserved: Iterable[int] = (), tolerance: float = 0.0, fixed: bool = False
    ) -> None:
        self._tolerance = tolerance
        self.fixed = fixed
        self._points: dict[int, ModelKeypoint] = {}
        self._last_reserved = max(reserved, default=0)
        self.file_ids = frozenset[int]()

    def __getitem__(self, semantic_id: int) -> ModelKeypoint:
        try:
            return self._points[semantic_id]
        except KeyError:
            what = f"there is no keypoint {semantic_id}"
            raise InputError(what, where="keypoint", fix="reload the page") from None

    def __iter__(self) -> Iterator[tuple[int, ModelKeypoint]]:
        return iter(self._points.items())

    def __contains__(self, semantic_id: object) -> bool:
        return semantic_id in self._points

    def add(self, point: ModelKeypoint) -> int:
        """Add a point and return its semantic id; missing ids and names are assigned."""
        number = point.semantic_id
        if number is None:
            number = 1 + max(self._last_reserved, *self._points, 0)
        name = self._free_name(point.name or f"point {number}")
        self._points[number] = replace(point, semantic_id=number, name=name)
        return number

    def merge(self, points: Iterable[ModelKeypoint]) -> None:
        """Add the points of a file; a point with the id and position of a known one renames it."""
        # Points with an id come first, so that new ids differ from theirs.
        for point in sorted(points, key=lambda each: each.semantic_id is None):
            number = point.semantic_id
            if number in self._points:
                if self.has(point):
                    del self._points[number]  # frees its name
                else:
                    point = replace(point, semantic_id=None)
            self.file_ids |= {self.add(point)}

    def has(self, point: ModelKeypoint) -> bool:
        """True if the keypoint with the point's id has the same position."""
        own = None if point.semantic_id is None else self._points.get(point.semantic_id)
        return own is not None and math.dist(own.xyz, point.xyz) <= self._tolerance

    def find_by_name(self, point: ModelKeypoint) -> int | None:
        """Find the id of the keypoint with the point's name, or with its id if it has no name."""
        for number, own in self:
            if own.name == point.name if point.name else number == point.semantic_id:
                return number
        return None

    def find(self, xyz: Sequence[float]) -> int | None:
        """Find the id of the nearest keypoint within the tolerance."""
        gaps = {number: math.dist(point.xyz, xyz) for number, point in self}
        nearest = min(gaps, key=gaps.__getitem__, default=None)
        return nearest if nearest is not None and gaps[nearest] <= self._tolerance else None

    def rename(self, semantic_id: int, name: str) -> None:
        """Rename a keypoint; raises InputError if the name is empty, too long or taken."""
        name = " ".join(name.split())
        if not name or len(name) > _LONGEST_NAME:
            what = f"the name {name[:_LONGEST_NAME]!r} is empty or too long"
            raise InputError(what, where="name", fix=f"give 1 to {_LONGEST_NAME} characters")
        point = self[semantic_id]
        if self.fixed and name != point.name:
            what = f"{point.name!r} is a keypoint of the shape, which keeps its name"
            raise InputError(what, where="name")
        if name != point.name and name in self._names:
            what = f"another keypoint is called {name!r}"
            raise InputError(what, where="name", fix="choose another name")
        self._points[semantic_id] = replace(point, name=name)

    @property
    def _names(self) -> set[str]:
        return {point.name for point in self._points.values()}

    def _free_name(self, name: str) -> str:
        taken, free, number = self._names, name, 2
        while free in taken:
            free, number = f"{name} ({number})", number + 1
        return free


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """Shape of the objects: a learned shape with its file, or the stretched model."""

    learned: ShapeModel | None = None
    path: Path | None = None

    @property
    def category(self) -> str | None:
        """Name of the category whose shape comes with cadalign; None for a shape from a file."""
        return category_of(self.path)

    @classmethod
    def open(cls, path: Path | None) -> ObjectShape:
        """Open a learned shape, if one is named; raises a CadalignError on failure."""
        if path is None:
            return cls()
        path = shape_path(path)
        return cls(ShapeModel.open(path), path)

    @property
    def ids(self) -> tuple[KeypointId, ...]:
        """Ids or names of the learned keypoints."""
        return () if self.learned is None else self.learned.ids

    @property
    def has_outline(self) -> bool:
        """True if masks and photos are evidence of the shape: a learned one needs meshes."""
        training = None if self.learned is None else self.learned.training
        return self.learned is None or bool(training and training.rows_with_mesh)

    def id_of(self, point: ModelKeypoint) -> KeypointId | None:
        """Return the id of a model's point in the estimate; None if the learned shape lacks it.

        The learned shape knows the point by its name, otherwise by its semantic id.
        """
        if self.learned is None:
            return point.semantic_id
        return self.learned.resolve([point.semantic_id], [point.name], where=None)[0]

    def knows(self, points: Sequence[ModelKeypoint]) -> BoolArray:
        """Return a mask (n,) of the points that the shape has, each once; their pairs count."""
        labels = [self.id_of(point) for point in points]
        firsts = [label not in (None, *labels[:row]) for row, label in enumerate(labels)]
        return np.array(firsts, dtype=bool)

    def name_of(self, point: ModelKeypoint) -> str:
        """Return the name of a point that the shape has, as the shape calls it."""
        names = () if self.learned is None else self.learned.names
        return names[self.ids.index(self.id_of(point))] if names else point.name


def positions_of(points: Iterable[ModelKeypoint]) -> FloatArray:
    """Positions (k, 3) of points [model units]."""
    return np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)
