"""The model's keypoints: those that came with it, and those that were placed by clicking."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import InputError

_LONGEST_NAME = 80


class KeypointBook:
    """Keypoints by semantic id; points are added and renamed, never moved or taken out.

    Parameters
    ----------
    given : iterable of ModelKeypoint
        Those that came with the model.

    Attributes
    ----------
    given : frozenset of int
        Their semantic ids.
    """

    def __init__(self, given: Iterable[ModelKeypoint] = ()) -> None:
        self._points: dict[int, ModelKeypoint] = {}
        # Those with an id first, so that the others don't take theirs.
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
        """Add a point; without a semantic id it gets the next one, without a name "point <id>".

        Returns
        -------
        int
            Its semantic id.
        """
        number = point.semantic_id
        if number is None:
            number = 1 + max(self._points, default=0)
        name = self._free_name(point.name or f"point {number}")
        self._points[number] = replace(point, semantic_id=number, name=name)
        return number

    def take_in(self, points: Iterable[ModelKeypoint], *, tolerance: float) -> None:
        """Take in points of an earlier session, which count as given from now on.

        Where a point has the id and, to the tolerance [model units], the place of one that is
        there already, it is that one, and its name counts.
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
        """The keypoint at a place, if there is one within the tolerance [model units]."""
        if not self._points:
            return None
        numbers = list(self._points)
        gaps = np.linalg.norm(self.xyz(numbers) - np.array(list(xyz)), axis=1)
        nearest = int(np.argmin(gaps))
        return numbers[nearest] if gaps[nearest] <= tolerance else None

    def rename(self, semantic_id: int, name: str) -> None:
        """Give a keypoint another name.

        Raises
        ------
        InputError
            If the name is empty, too long, or another keypoint's.
        """
        name = " ".join(name.split())
        if not name or len(name) > _LONGEST_NAME:
            raise InputError(
                f"{name[:_LONGEST_NAME]!r} is not a name",
                where="name",
                fix=f"give 1 to {_LONGEST_NAME} characters",
            )
        point = self[semantic_id]
        if name != point.name and name in self._names:
            raise InputError(f"another keypoint is called {name!r}", where="name")
        self._points[semantic_id] = replace(point, name=name)

    @property
    def _names(self) -> set[str]:
        return {point.name for point in self._points.values()}

    def _free_name(self, name: str) -> str:
        """The name, or with a number behind it where it is taken."""
        taken, free, number = self._names, name, 2
        while free in taken:
            free, number = f"{name} ({number})", number + 1
        return free
