"""Work list of a folder: how far the annotation of each photo has got, by hand and by its pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from cadalign.errors import DataError
from cadalign.io.documents import Document, read_document
from cadalign.io.files import write_json

Mark = Literal["done", "skipped"]
State = Literal["to do", "begun", "done", "skipped"]
STATES: tuple[State, ...] = ("to do", "begun", "done", "skipped")
FILE = "cadalign.worklist.json"
_FORMAT = "cadalign work list"


class _File(Document):
    format: str
    photos: dict[str, Mark]


@dataclass(frozen=True)
class WorkList:
    """Photos that are marked as done or skipped, by their file names, and the file of the list."""

    path: Path
    marks: Mapping[str, Mark] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path) -> WorkList:
        """Read the list of a folder; an empty one if there is none."""
        path = folder / FILE
        if not path.exists():
            return cls(path)
        read = read_document(path, _File)
        if read.format != _FORMAT:
            raise DataError(f"not a {_FORMAT}", where=str(path), fix="rename it")
        return cls(path, read.photos)

    def state(self, photo: str, *, pairs: int) -> State:
        """The state of a photo of so many pairs."""
        return self.marks.get(photo) or ("begun" if pairs else "to do")

    def marked(self, photo: str, mark: Mark | None) -> WorkList:
        """The list with a photo marked, or without its mark; its file is written."""
        marks = {name: kept for name, kept in self.marks.items() if name != photo}
        if mark is not None:
            marks[photo] = mark
        write_json(self.path, {"format": _FORMAT, "photos": dict(sorted(marks.items()))})
        return WorkList(self.path, marks)
