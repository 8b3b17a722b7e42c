"""Inputs of a run over many observations, as tasks of which memory holds few at a time.

An input is an observation file, a folder of such files, JSON lines (an observation in every line,
``.jsonl`` or ``.ndjson``), or a detector's file of keypoints
(`cadalign.datasets.read_image_keypoints`).
"""

from __future__ import annotations

import hashlib
import os
from array import array
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec

from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.errors import DataError
from cadalign.evaluation.runs.work import fingerprint, fingerprint_of_files
from cadalign.io.documents import path_from, read_json
from cadalign.io.files import listed, open_input, read_bytes, read_text
from cadalign.io.kinds import DETECTOR, LINES, OBSERVATION, TABLE, kind_of, refuse_other_file

_INVALID = (msgspec.MsgspecError, UnicodeError, RecursionError)
_CELLS = 3  # of a task: the number of its file, its own in it, and the byte where it begins


class ObservationTask(NamedTuple):
    """One observation of a run."""

    row: int
    """Its number in the run."""
    name: str
    """Its file, with the line or the object where the file holds several."""
    content: str | bytes | ImageKeypoints | DataError
    """Its JSON, bytes of a line, or a detector's keypoints; or why these cannot be read."""
    folder: str
    """The folder that paths in it are relative to, the same for a worker elsewhere."""


class ObservationTasks(Sequence[ObservationTask]):
    """The observations of all inputs; of a file of lines it keeps where each begins.

    Raises DataError if a file cannot be read, or an input holds no observation.
    """

    def __init__(self, inputs: Iterable[Path]) -> None:
        self._files: list[Path] = []
        self._cells = array("q")
        self._objects: dict[int, list[tuple[str, ImageKeypoints | DataError]]] = {}
        self._marks: list[str] = []
        self._named: dict[Path, None] = {}
        for path in inputs:
            for file, data in _files_of(path):
                self._add(file, data)

    @property
    def has_detections(self) -> bool:
        """True where an input is a detector's file."""
        return bool(self._objects)

    def fingerprint(self) -> str:
        """A text that changes with the inputs, and with the photos, masks and meshes they name."""
        return fingerprint("\n".join((*self._marks, fingerprint_of_files(self._named))))

    def __len__(self) -> int:
        return len(self._cells) // _CELLS

    def __getitem__(self, place: Any) -> Any:
        rows = range(len(self))[place]
        if isinstance(rows, int):
            return self[rows : rows + 1][0]
        with ExitStack() as opened:
            found: dict[int, BinaryIO] = {}
            return [self._task(row, found, opened) for row in rows]

    def _task(self, row: int, files: dict[int, BinaryIO], opened: ExitStack) -> ObservationTask:
        number, own, start = self._cells[_CELLS * row : _CELLS * (row + 1)]
        path = self._files[number]
        name: str = str(path)
        content: Any = None
        if number in self._objects:
            name, content = self._objects[number][own]
        elif path.suffix.lower() in LINES:
            if number not in files:
                files[number] = opened.enter_context(open_input(path))
            files[number].seek(start)
            name, content = f"{path}, line {own}", files[number].readline()
        else:
            try:
                content = read_text(path)
            except DataError as error:
                content = error
        return ObservationTask(row, name, content, str(path.absolute().parent))

    def _add(self, path: Path, data: Any) -> None:
        number, suffix = len(self._files), path.suffix.lower()
        self._files.append(path)
        if suffix in LINES:
            self._add_lines(number, path)
        elif suffix == TABLE or kind_of(data) == DETECTOR:
            # Which memory holds whole; objects that cannot be read come last.
            bad: dict[str, DataError] = {}
            good = read_image_keypoints(path, problems=bad)
            self._objects[number] = [*((each.source, each) for each in good), *bad.items()]
            self._marks.append(fingerprint(read_bytes(path)))
            for own in range(len(self._objects[number])):
                self._cells.extend((number, own, 0))
        else:
            self._marks.append(fingerprint_of_files([path]))
            self._cells.extend((number, 0, 0))
            self._named.update(dict.fromkeys(_named_files(data, path.parent)))

    def _add_lines(self, number: int, path: Path) -> None:
        """Find where the lines of a file begin; empty ones are passed over."""
        place, digest, before = 0, hashlib.sha256(), len(self._cells)
        with open_input(path) as file:
            for own, line in enumerate(file, start=1):
                mark = len(BOM_UTF8) if own == 1 and line.startswith(BOM_UTF8) else 0
                if line[mark:].strip():  # behind the mark that programs of Windows write
                    self._cells.extend((number, own, place + mark))
                    with suppress(*_INVALID):  # whoever reads it says so
                        named = _named_files(msgspec.json.decode(line[mark:]), path.parent)
                        self._named.update(dict.fromkeys(named))
                place += len(line)
                digest.update(line)
        if len(self._cells) == before:
            raise DataError("the file holds no observation", where=str(path))
        self._marks.append(digest.hexdigest())


def _files_of(path: Path) -> Iterator[tuple[Path, Any]]:
    """The files of an input; with those of JSON their content, None if it is damaged."""
    suffix = path.suffix.lower()
    if os.path.isdir(path):  # also of a name that no file can have
        yield from _files_in(path)
    elif suffix in (*LINES, TABLE):
        yield path, None
    else:
        data = _content(path)
        if kind_of(data) not in (DETECTOR, OBSERVATION):
            refuse_other_file(path, OBSERVATION)
        yield path, data


def _files_in(folder: Path) -> Iterator[tuple[Path, Any]]:
    """The observations of a folder, whose other JSON files are passed over."""
    is_empty = True
    for path in listed(folder):
        suffix = path.suffix.lower()
        if not path.is_file() or suffix not in (".json", *LINES):
            continue
        data = _content(path) if suffix == ".json" else None
        if data is None or kind_of(data) == OBSERVATION:
            is_empty = False
            yield path, data
    if is_empty:
        fix = "`cadalign annotate` and `cadalign observe` write them"
        raise DataError("the folder holds no observation", where=str(folder), fix=fix)


def _content(path: Path) -> Any:
    with suppress(DataError, *_INVALID):
        return msgspec.json.decode(read_bytes(path))
    with suppress(DataError):
        return read_json(path)  # slower, but knows the NaN that Python's JSON has
    return None


def _named_files(data: Any, folder: Path) -> Iterator[Path]:
    """Photos, masks and meshes that an observation names, in its parsed form, valid or not."""
    given = data if isinstance(data, Mapping) else {}
    views = given.get("views")
    for part in (given, *(views if isinstance(views, list) else ())):
        for name in ("image", "model", "shape", "mask", "depth"):
            path = part.get(name) if isinstance(part, Mapping) else None
            if isinstance(path, str) and path:
                yield path_from(path, folder)
