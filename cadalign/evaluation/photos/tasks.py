"""The tasks of the experiment on photos: one for each photo, read when it is evaluated."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.formats import open_photos
from cadalign.errors import DataError
from cadalign.evaluation.runs.tables import Row

UNREADABLE = "unreadable"
"""The category of records that cannot be read."""


@dataclass(frozen=True)
class PhotoTask:
    """One photo of a data set, by its number.

    Parameters
    ----------
    index : int
        Its number in the data set; -1 of a record that is no photo.
    name : str
    problem : str
        Reason why the record cannot be read at all; empty otherwise.
    """

    index: int
    name: str
    problem: str = ""

    @property
    def names(self) -> Row:
        """The cells that name the rows of the whole record, but for the method."""
        return {"category": UNREADABLE, "model_id": self.name, "view": 0}


class PhotoTasks(Sequence[PhotoTask]):
    """The photos of a data set, then the records that its listing could not read."""

    def __init__(self, dataset: PhotoDataset, max_photos: int | None) -> None:
        self._names = dataset.names[:max_photos]
        bad = dataset.problems.items() if max_photos is None else ()
        self._bad = tuple((name, str(error)) for name, error in bad)
        if not len(self):
            raise DataError("there are no photos", where=str(dataset.root))

    def __len__(self) -> int:
        return len(self._names) + len(self._bad)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = range(len(self))[index]
        if place < len(self._names):
            return PhotoTask(place, self._names[place])
        return PhotoTask(-1, *self._bad[place - len(self._names)])

    def fingerprint(self) -> str:
        """Hash of the photos' names: a run must not go on with others."""
        digest = hashlib.sha256("\0".join(self._names).encode("utf-8", "replace"))
        digest.update(repr(self._bad).encode("utf-8", "replace"))
        return digest.hexdigest()[:16]


opened = lru_cache(maxsize=1)(open_photos)
"""The data set of a folder, listed once in every process."""
