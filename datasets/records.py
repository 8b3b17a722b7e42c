"""Data sets whose records are read one by one; a malformed record does not stop the others."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from cadalign.errors import CadalignError, DataError, quote
from cadalign.io.documents import name_file, read_json
from cadalign.io.files import damage_error

logger = logging.getLogger("cadalign")

T = TypeVar("T")
# Maximum number of logged warnings per data set; `problems` holds all errors.
_LOGGED = 20


class RecordSet(ABC, Generic[T]):
    """A data set of named records, such as photos.

    ``len`` counts all records. Iteration yields the readable ones and logs a warning (logger
    "cadalign") for each of the others. `problems` holds the errors so far, by name. Access to a
    record by position or name raises its error.

    Parameters
    ----------
    root : Path
        The folder or file.
    names : iterable of str
        The records' names.
    problems : dict of str to DataError, optional
        Errors of parts that could not be listed; the first is raised if there are no records.
    """

    kind: str = "data set"
    """Name of the format."""
    noun: str = "record"
    """Noun for a record, for messages."""
    signature: str = ""
    """Files by which the format is recognised, for messages."""
    marks: tuple[str, ...] = ()
    """Patterns of files; a folder of this format has a file that matches one of them."""

    def __init__(
        self, root: Path, names: Iterable[str], problems: dict[str, DataError] | None = None
    ) -> None:
        self.root = root
        self.names = tuple(names)
        """The records' names, in order."""
        self.problems = problems or {}
        """Errors of the records, or parts of them, that could not be read so far, by name."""
        if self.problems and not self.names:
            raise next(iter(self.problems.values()))

    @classmethod
    def is_here(cls, folder: Path) -> bool:
        """True if a folder has this format."""
        return any(next(folder.glob(pattern), None) is not None for pattern in cls.marks)

    @abstractmethod
    def read(self, index: int) -> T:
        """Read the record at a position, counted from 0; raises `DataError` if it is malformed."""

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, key: int | str) -> T:
        """Read the record at a position or of a name.

        Raises DataError if the record is malformed or the name is unknown, IndexError if the
        position is out of range.
        """
        if isinstance(key, str):
            if key not in self.names:
                raise DataError(f"no {self.noun} {key!r}", where=str(self.root))
            key = self.names.index(key)
        if not -len(self) <= key < len(self):
            raise IndexError(f"there is no {self.noun} {key} of {len(self)}")
        return self._read(key % len(self))

    def __iter__(self) -> Iterator[T]:
        for index, name in enumerate(self.names):
            try:
                record = self._read(index)
            except DataError as error:
                self._log_problem(name, error)
                continue
            yield record

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r}): {len(self)} {self.noun}s"

    def _read(self, index: int) -> T:
        try:
            with np.errstate(all="ignore"):  # values that are not finite are refused by name
                return self.read(index)
        except DataError:
            raise
        except CadalignError:  # a value that a camera or a pose refuses
            with name_file(f"{self.root}, {self.names[index][:200]}"):
                raise

    def _log_problem(self, name: str, error: DataError) -> None:
        if name not in self.problems and len(self.problems) <= _LOGGED:
            more = " (further problems are not logged)" if len(self.problems) == _LOGGED else ""
            logger.warning("%s: left out: %s%s", self.kind, error, more)
        self.problems[name] = error.with_traceback(None)


@contextmanager
def collect_error(name: str, problems: dict[str, DataError] | None) -> Iterator[None]:
    """Store the error of a record that cannot be read in ``problems``, or raise it if None."""
    try:
        yield
    except DataError as error:
        if problems is None:
            raise
        problems[name] = error


def read_list(path: Path) -> list[Any]:
    """Read a JSON file that holds a list.

    Raises DataError if the file cannot be read, is not valid JSON, or does not hold a list.
    """
    try:
        found = read_json(path)
    except DataError as error:
        raise damage_error(error.what, error.where) from None
    if not isinstance(found, list):
        raise DataError(f"{quote(found)} is not a list", where=str(path))
    return found
