"""Photos of a data set and their JSON records, read when asked for: no bad one stops the rest."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.photo import Photo, PhotoObject
from cadalign.datasets.records import RecordSet
from cadalign.errors import CadalignError, DataError, quote
from cadalign.io.documents import read_json
from cadalign.io.files import damaged, read_text

K = TypeVar("K", bound=Hashable)
_Record = TypeVar("_Record")


class PhotoDataset(RecordSet[Photo]):
    """A data set of photos; see `cadalign.datasets.records.RecordSet`.

    Objects that could not be read in a photo are among the `problems`, too.

    Examples
    --------
    >>> for photo in cadalign.datasets.open("pix3d"):  # doctest: +SKIP
    ...     for found in photo.objects:
    ...         print(photo.name, found.category, found.truth.cam_from_model)
    """

    kind = "photos"
    noun = "photo"
    patterns: tuple[str, ...] = ("*.json",)
    """Patterns of the annotations' files, below the folder."""

    def __iter__(self) -> Iterator[Photo]:
        for photo in super().__iter__():
            for number, problem in enumerate(photo.problems):
                self._tell(f"{photo.name}, problem {number + 1}", problem)
            yield photo

    def annotation_files(self) -> list[Path]:
        """List the files of the annotations, by which a run knows those that it began with."""
        found = (path for pattern in self.patterns for path in self.root.glob(pattern))
        return sorted({path for path in found if path.is_file()})


@contextmanager
def leaving_out(name: K, problems: MutableMapping[K, DataError] | None) -> Iterator[None]:
    """Leave out a record that cannot be read, and keep the reason why in ``problems``.

    Without problems the reason is raised.
    """
    try:
        yield
    except DataError as error:
        if problems is None:
            raise
        problems[name] = error


def read_each(
    records: Iterable[_Record], read: Callable[[int, _Record], PhotoObject | None], *, where: str
) -> tuple[tuple[PhotoObject, ...], tuple[DataError, ...]]:
    """Read a photo's objects, and the reasons why some could not be read.

    ``read`` makes the object of a number and a record, None for one that is left out on purpose;
    ``where`` is the place of the records, for messages.
    """
    found: list[PhotoObject] = []
    problems: list[DataError] = []
    for number, record in enumerate(records):
        try:
            each = read(number, record)
        except CadalignError as error:
            place = f"{where}, object {number}"
            if error.where:
                has_file = error.where.startswith(where)
                place = error.where if has_file else f"{place}: {error.where}"
            problems.append(DataError(error.what, where=place, fix=error.fix))
            continue
        if each is not None:
            found.append(each)
    return tuple(found), tuple(problems)


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


def read_matrix(path: Path, shape: tuple[int | None, int]) -> FloatArray:
    """Read a text file of a matrix, a row on each line; None for any number of rows.

    Raises DataError if it cannot be read, or is not a matrix of finite numbers of this shape.
    """
    text = read_text(path)
    rows = [line.split() for line in text.splitlines() if line.strip()]
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        raise damaged("not a table of numbers", path) from None
    rows_wanted, columns = shape
    if matrix.shape != (rows_wanted or len(matrix), columns):
        wanted = f"{rows_wanted or 'some'} rows of {columns} numbers"
        raise damaged(f"shape {matrix.shape}, expected {wanted}", path)
    if not np.isfinite(matrix).all():
        raise DataError("some of its numbers are not finite", where=str(path))
    return matrix
