"""Tasks of the experiment on real correspondences: draws of scales and outliers for images."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from cadalign.datasets import Correspondences, CorrespondenceSet
from cadalign.errors import DataError
from cadalign.evaluation.correspondences.options import CorrespondenceOptions
from cadalign.evaluation.runs.tables import Row


@dataclass(frozen=True, eq=False)
class CorrespondenceTask:
    """One draw of scales for one image, with a share of its points to be moved.

    ``seen`` is None where the image cannot be read, for the reason ``problem``.
    """

    image: str
    outliers: float
    draw: int
    seen: Correspondences | None
    problem: str = ""

    @property
    def names(self) -> Row:
        """The cells that name its rows, but for the method."""
        return {"image": self.image, "draw": self.draw, "outliers": self.outliers}


class CorrespondenceTasks(Sequence[CorrespondenceTask]):
    """All draws, image by image and share by share, made when asked for."""

    def __init__(self, images: CorrespondenceSet, options: CorrespondenceOptions) -> None:
        self._images = images
        self._outliers = options.outliers
        self._draws = options.draws
        self._ids = images.ids[: options.max_images]
        if not self._ids:
            raise DataError("there are no images", where=str(images.source))
        problems = images.problems
        self._problems = {name: problems[name] for name in self._ids if name in problems}
        if len(self._problems) == len(self._ids):
            first = self._problems[self._ids[0]]
            raise DataError(
                f"none of {len(self._ids)} images can be read; the first: {first}",
                where=str(images.source),
            )
        self._read = lru_cache(maxsize=2)(self._read_image)

    def __len__(self) -> int:
        return len(self._ids) * len(self._outliers) * self._draws

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        rest, draw = divmod(range(len(self))[index], self._draws)
        place, share = divmod(rest, len(self._outliers))
        name = self._ids[place]
        problem = self._problems.get(name)
        return CorrespondenceTask(
            image=name,
            outliers=self._outliers[share],
            draw=draw,
            seen=self._read(name) if problem is None else None,
            problem="" if problem is None else str(problem),
        )

    def fingerprint(self) -> str:
        """Hash of all that is read: a run must not go on with other data."""
        digest = hashlib.sha256()
        for name in self._ids:
            digest.update(f"{name}\0".encode())
            if name in self._problems:
                digest.update(str(self._problems[name]).encode())
                continue
            seen = self._read(name)
            pose = seen.cam_from_world
            for values in (seen.points_3d, seen.points_2d, pose.rotation, pose.translation):
                digest.update(np.ascontiguousarray(values).tobytes())
            digest.update(repr(seen.camera).encode())
        return digest.hexdigest()[:16]

    def _read_image(self, name: str) -> Correspondences:
        return self._images[name]
