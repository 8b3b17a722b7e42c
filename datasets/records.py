"""Records of a data set, read one at a time when they are asked for: no bad one stops the rest."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from cadalign.errors import CadalignError, DataError, quote
from cadalign.io.documents import read_json
from cadalign.io.files import damaged

logger = logging.getLogger("cadalign")

T = TypeVar("T")
# Warnings of one data set that are logged; `problems` has all.
_LOGGED = 20


class RecordSet(ABC, Generic[T]):
    """A data set of named records, such as photos.

    ``len`` counts the records listed; iterating gives the readable ones, with a warning (logger
    "cadalign") for each of the others. `problems` holds the reasons met so far, by name. Asking
    for one record by its number or name raises the reason.

    Parameters
    ----------
    root : Path
        The folder or file.
    names : iterable of str
        The records' names.
    problems : dict of str to DataError, optional
        Why parts of the data set could not be listed; the first is raised where nothing could.
    """

    kind: str = "data set"
    """Name of the format."""
    noun: str = "record"
    """What a record is, for messages."""
    signature: str = ""
    """What the format is recognised by, for messages."""
    marks: tuple[str, ...] = ()
    """Patterns of files or folders of which a folder of this format has one."""

    def __init__(
        self, root: Path, names: Iterable[str], problems: dict[str, DataError] | None = None
    ) -> None:
        self.root = root
        self.names = tuple(names)
        """The records' names, in order."""
        self.problems = problems or {}
        """Why records or parts of them could not be read, of those read so far, by name."""
        if self.problems and not self.names:
            raise next(iter(self.problems.values()))

    @classmethod
    def is_here(cls, folder: Path) -> bool:
        """True for a folder that holds this format."""
        return any(next(folder.glob(pattern), None) is not None for pattern in cls.marks)

    @abstractmethod
    def read(self, index: int) -> T:
        """Read the record of a number from 0; raises `DataError` if it is bad."""

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, key: int | str) -> T:
        """The record of a number or name.

        Raises DataError if it is bad or none has this name, IndexError if the number is out of
        range.
        """
        if isinstance(key, str):
            if key not in self.names:
                raise DataError(f"no {self.noun} {key!r}", where=str(self.root))
            key = self.names.index(key)
        if not -len(self) <= key < len(self):
            raise IndexError(f"{len(self)} {self.noun}s, asked for number {key}")
        return self._read(key % len(self))

    def __iter__(self) -> Iterator[T]:
        for index, name in enumerate(self.names):
            try:
                record = self._read(index)
            except DataError as error:
                self._tell(name, error)
                continue
            yield record

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r}): {len(self)} {self.noun}s"

    def _read(self, index: int) -> T:
        try:
            with np.errstate(all="ignore"):  # what is not finite in the end is refused by name
                return self.read(index)
        except DataError:
            raise
        except CadalignError as error:  # a value that a camera or a pose refuses
            where = f"{self.root}, {self.names[index][:200]}"
            where += f": {error.where}" if error.where else ""
            raise DataError(error.what, where=where, fix=error.fix) from None

    def _tell(self, name: str, error: DataError) -> None:
        if name not in self.problems and len(self.problems) <= _LOGGED:
            more = " (further problems are counted only)" if len(self.problems) == _LOGGED else ""
            logger.warning("%s: left out: %s%s", self.kind, error, more)
        self.problems[name] = error.with_traceback(None)


@contextmanager
def leaving_out(name: str, problems: dict[str, DataError] | None) -> Iterator[None]:
    """Leave out a record that cannot be read, and keep the reason why in ``problems``.

    Without problems the reason is raised.
    """
    try:
        yield
    except DataError as error:
        if problems is None:
            raise
        problems[name] = error


def read_list(path: Path) -> list[Any]:
    """Read a JSON file that holds a list.

    Raises DataError if it cannot be read, is no valid JSON (cut short, say), or holds no list.
    """
    try:
        found = read_json(path)
    except DataError as error:
        raise damaged(error.what, error.where) from None
    if not isinstance(found, list):
        raise DataError(f"{quote(found)} is not a list", where=str(path))
    return found
