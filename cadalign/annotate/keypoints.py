"""Keypoints of a model: given with it, placed by clicking, or proposed by a detector."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cadalign.annotate.photos import PhotoFile
from cadalign.arrays import FloatArray
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import DataError, InputError

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


@dataclass(frozen=True)
class Proposal:
    """A keypoint of the model, where a detector has found it [px], and how sure it is."""

    keypoint: int
    uv: tuple[float, float]
    score: float | None = None


def read_proposals(
    path: Path, photos: Sequence[PhotoFile], registry: KeypointRegistry
) -> list[tuple[Proposal, ...]]:
    """Read COCO's keypoints or a detector's for each photo, by its file name.

    Of several objects in a photo the surest counts. Keypoints are found by name, else by semantic
    id; those of a file with neither by their order, if there are as many as the model has. Raises
    DataError if no photo or no keypoint of the model is in the file.
    """
    found = read_image_keypoints(path)
    by_photo = []
    for photo in photos:
        names = (photo.path.name, photo.path.stem)
        own = [each for each in found if each.image and Path(each.image).name in names]
        if not own and len(photos) == 1:
            own = found
        own.sort(key=lambda each: -(each.score or 0.0))
        by_photo.append(_proposals(own[0], photo, registry) if own else ())
    if not any(by_photo):
        raise DataError(
            "has no keypoint of the model in any of the photos",
            where=str(path),
            fix="its images and keypoints must be called as the photos and the model's keypoints",
        )
    return by_photo


def _proposals(
    found: ImageKeypoints, photo: PhotoFile, registry: KeypointRegistry
) -> tuple[Proposal, ...]:
    by_name = {point.name: number for number, point in registry}
    count = len(found.points_2d)
    wanted: list[int | None]
    if found.names is not None:
        wanted = [by_name.get(name) for name in found.names]
    elif found.semantic_ids is not None:
        wanted = [number if number in registry else None for number in found.semantic_ids]
    else:
        numbers = sorted(number for number, _ in registry)
        wanted = list(numbers) if len(numbers) == count else [None] * count
    scores = [None] * count if found.scores is None else found.scores.tolist()
    proposals = []
    for keypoint, (u, v), score in zip(wanted, found.points_2d.tolist(), scores, strict=True):
        inside = -0.5 <= u <= photo.width - 0.5 and -0.5 <= v <= photo.height - 0.5
        if keypoint is not None and inside and score != 0:
            proposals.append(Proposal(keypoint, (u, v), score))
    return tuple(proposals)
