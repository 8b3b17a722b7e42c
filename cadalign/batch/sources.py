"""Inputs of a run over many observations, as tasks that are read when they are needed.

An input is an observation file, a folder of observation files, JSON lines (one observation per
line, ``.jsonl`` or ``.ndjson``), or a detector's keypoint file
(`cadalign.datasets.read_image_keypoints`).
"""

from __future__ import annotations

import hashlib
import os
from array import array
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

from cadalign.datasets.image_keypoints import ImageKeypoints
from cadalign.datasets.keypoint_files import read_image_keypoints
from cadalign.errors import DataError
from cadalign.io.documents import read_json
from cadalign.io.files import list_folder, open_input, read_bytes, read_text
from cadalign.io.kinds import DETECTOR, LINES, OBSERVATION, TABLE, kind_of, refuse_other_file

_CELLS = 3  # per task: index of its source, its index or line there, offset of its line


class ObservationTask(NamedTuple):
    """One observation of a run."""

    row: int
    """Index in the run."""
    name: str
    """File; with the line or object if the file holds several."""
    content: str | bytes | ImageKeypoints | DataError
    """JSON text, the bytes of a line, a detector's keypoints, or the error of reading them."""
    folder: str
    """Absolute folder, to which paths in the content are relative."""


class ObservationTasks(Sequence[ObservationTask]):
    """The observations of all inputs; of JSON lines, only the offsets are held in memory.

    Raises DataError if a file cannot be read, or an input holds no observation.
    """

    def __init__(self, inputs: Iterable[Path]) -> None:
        self._digest = hashlib.sha256()
        self._sources: list[Path] = []
        self._cells = array("q")
        self._objects: dict[int, list[tuple[str, Any]]] = {}  # of detectors' files
        for file, kind in chain.from_iterable(map(_files_of, inputs)):
            before = len(self._cells)
            for own, start in self._entries(file, kind):
                self._cells.extend((len(self._sources), own, start))
            if len(self._cells) == before:
                raise DataError("the file holds no observation", where=str(file))
            self._sources.append(file)

    @property
    def has_detections(self) -> bool:
        """True if an input is a detector's file."""
        return bool(self._objects)

    @property
    def fingerprint(self) -> str:
        """A text that changes with the inputs' content."""
        return self._digest.hexdigest()

    def __len__(self) -> int:
        return len(self._cells) // _CELLS

    def __getitem__(self, place: Any) -> Any:
        rows = range(len(self))[place]
        if isinstance(rows, int):
            return self[rows : rows + 1][0]
        with ExitStack() as opened:
            files: dict[int, BinaryIO] = {}
            return [self._task(row, files, opened) for row in rows]

    def _task(self, row: int, files: dict[int, BinaryIO], opened: ExitStack) -> ObservationTask:
        source, own, start = self._cells[_CELLS * row : _CELLS * (row + 1)]
        path = self._sources[source]
        name, content = os.fspath(path), cast(Any, None)
        if source in self._objects:
            name, content = self._objects[source][own]
        elif own:  # a line
            if source not in files:
                files[source] = opened.enter_context(open_input(path))
            files[source].seek(start)
            name, content = f"{name}, line {own}", files[source].readline()
        else:
            try:
                content = read_text(path)
            except DataError as error:
                content = error
        return ObservationTask(row, name, content, os.path.dirname(os.path.abspath(path)))

    def _entries(self, path: Path, kind: str | None) -> Iterator[tuple[int, int]]:
        """Yield the index, or the line's number and offset, of each task in a file."""
        if path.suffix.lower() in LINES:
            place = 0
            with open_input(path) as file:
                for own, line in enumerate(file, start=1):
                    mark = len(BOM_UTF8) if own == 1 and line.startswith(BOM_UTF8) else 0
                    if line[mark:].strip():  # after a byte order mark
                        yield own, place + mark
                    place += len(line)
                    self._digest.update(line)
            return
        with suppress(DataError):  # reported in the row of the task
            self._digest.update(read_bytes(path))
        count = 1
        if kind == DETECTOR:
            # Held in memory; unreadable objects come last.
            bad: dict[str, DataError] = {}
            good = read_image_keypoints(path, problems=bad)
            objects = [*((each.source, each) for each in good), *bad.items()]
            self._objects[len(self._sources)], count = objects, len(objects)
        yield from ((own, 0) for own in range(count))


def _files_of(path: Path) -> Iterator[tuple[Path, str | None]]:
    """Yield the files of an input with their kinds; of a folder, only observation files."""
    if not os.path.isdir(path):  # also for an invalid file name
        kind = _kind_of(path)
        if kind not in (DETECTOR, OBSERVATION):
            refuse_other_file(path, OBSERVATION)
        yield path, kind
        return
    is_empty = True
    for each in list_folder(path):
        if each.suffix.lower() in (".json", *LINES) and each.is_file():
            kind = _kind_of(each)
            if kind == OBSERVATION:
                is_empty = False
                yield each, kind
    if is_empty:
        fix = "`cadalign annotate` and `cadalign observe` write them"
        raise DataError("the folder holds no observation", where=str(path), fix=fix)


def _kind_of(path: Path) -> str | None:
    suffix = path.suffix.lower()
    if suffix in (*LINES, TABLE):
        return DETECTOR if suffix == TABLE else OBSERVATION
    try:
        return kind_of(read_json(path))
    except DataError:  # reported in its row
        return OBSERVATION
