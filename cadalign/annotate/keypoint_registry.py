"""Registry of the model's keypoints: those given with it, and those placed by clicking."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError

_LONGEST_NAME = 80


class KeypointRegistry:
    """Keypoints by semantic id; points can be added and renamed, but not moved or removed.

    The attribute ``given`` holds the semantic ids of those given with the model. New points don't
    get ids that are ``reserved``.
    """

    def __init__(
        self, given: Iterable[ModelKeypoint] = (), *, reserved: Iterable[int] = ()
    ) -> None:
        self._points: dict[int, ModelKeypoint] = {}
        self._last_reserved = max(reserved, default=0)
        # Points with an id come first, so that new ids differ from theirs.
        ordered = sorted(given, key=lambda point: point.semantic_id is None)
        self.given = frozenset(self.add(point) for point in ordered)

    def __getitem__(self, semantic_id: int) -> ModelKeypoint:
        try:
            return self._points[semantic_id]
        except KeyError:
            raise InputError(
                f"there is no keypoint {semantic_id}", where="keypoint", fix="reload the page"
            ) from None

    def __iter__(self) -> Iterator[tuple[int, ModelKeypoint]]:
        return iter(self._points.items())

    def __len__(self) -> int:
        return len(self._points)

    def __contains__(self, semantic_id: object) -> bool:
        return semantic_id in self._points

    def xyz(self, semantic_ids: Iterable[int]) -> FloatArray:
        """Positions (k, 3) of some keypoints [model units]."""
        return np.array([self[number].xyz for number in semantic_ids], dtype=float).reshape(-1, 3)

    def add(self, point: ModelKeypoint) -> int:
        """Add a point and return its semantic id; missing ids and names are assigned."""
        number = point.semantic_id
        if number is None:
            number = 1 + max(self._last_reserved, *self._points, 0)
        name = self._free_name(point.name or f"point {number}")
        self._points[number] = replace(point, semantic_id=number, name=name)
        return number

    def add_as(self, semantic_id: int, point: ModelKeypoint) -> int:
        """Add a point under an id; raises InputError if another has it."""
        if semantic_id in self:
            raise InputError(
                f"the model has its keypoint {semantic_id} already",
                where="label",
                fix="click on that one",
            )
        return self.add(replace(point, semantic_id=semantic_id))

    def merge(self, points: Iterable[ModelKeypoint], *, tolerance: float) -> None:
        """Add points of an earlier session, which then count as given.

        A point with the id and, within the tolerance [model units], the position of a registered
        one renames that one.
        """
        for point in points:
            number = point.semantic_id
            if number is not None and number in self:
                if np.linalg.norm(np.subtract(self[number].xyz, point.xyz)) <= tolerance:
                    del self._points[number]  # or its own name would be taken
                    self.add(point)
                    continue
                point = replace(point, semantic_id=None)
            self.given |= {self.add(point)}

    def find(self, xyz: Iterable[float], *, tolerance: float) -> int | None:
        """Find the id of the keypoint at a position, within the tolerance [model units]."""
        if not self._points:
            return None
        numbers = list(self._points)
        gaps = np.linalg.norm(self.xyz(numbers) - np.array(list(xyz)), axis=1)
        nearest = int(np.argmin(gaps))
        return numbers[nearest] if gaps[nearest] <= tolerance else None

    def rename(self, semantic_id: int, name: str) -> None:
        """Rename a keypoint; raises InputError if the name is empty, too long or taken."""
        name = " ".join(name.split())
        if not name or len(name) > _LONGEST_NAME:
            raise InputError(
                f"the name {name[:_LONGEST_NAME]!r} is empty or too long",
                where="name",
                fix=f"give 1 to {_LONGEST_NAME} characters",
            )
        point = self[semantic_id]
        if name != point.name and name in self._names:
            raise InputError(
                f"another keypoint is called {name!r}", where="name", fix="choose another name"
            )
        self._points[semantic_id] = replace(point, name=name)

    @property
    def _names(self) -> set[str]:
        return {point.name for point in self._points.values()}

    def _free_name(self, name: str) -> str:
        """The name, with a number appended if it is taken."""
        taken, free, number = self._names, name, 2
        while free in taken:
            free, number = f"{name} ({number})", number + 1
        return free
