"""Inputs of a run over many observations, as tasks of which memory holds few at a time.

An input is an observation file, a folder or a pattern of such files, JSON lines (an observation in
every line, ``.jsonl`` or ``.ndjson``), or a detector's file of keypoints
(`cadalign.datasets.read_image_keypoints`).
"""

from __future__ import annotations

import hashlib
from array import array
from bisect import bisect_right
from codecs import BOM_UTF8
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from glob import glob
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.errors import DataError
from cadalign.evaluation.runs.work import fingerprint, fingerprint_of_files
from cadalign.io.documents import read_json
from cadalign.io.files import listed, open_input, read_bytes
from cadalign.io.kinds import (
    DETECTOR,
    LINES,
    OBSERVATION,
    TABLE,
    is_pattern,
    kind_of,
    refuse_other_file,
)
from cadalign.io.observation_file import named_files

_DAMAGED = "damaged"


class ObservationTask(NamedTuple):
    """One observation of a run."""

    row: int
    """Its number in the run."""
    name: str
    """Its file, with the line or the object where the file holds several."""
    content: bytes | ImageKeypoints | DataError | None
    """Its JSON, or a detector's keypoints, or why these cannot be read; None to read the file
    ``name``."""
    folder: str
    """The folder that paths in it are relative to."""


class Files(list[Path]):
    """Observation files, one each."""

    def tasks(self, first: int, last: int) -> list[ObservationTask]:
        """Those from ``first`` on, ``last`` left out; their rows count within the source."""
        chosen = enumerate(self[first:last], start=first)
        return [ObservationTask(row, str(path), None, _folder(path)) for row, path in chosen]

    def fingerprint(self) -> str:
        return fingerprint_of_files(self)

    def named_files(self) -> Iterator[Path]:
        for path in self:
            with suppress(DataError):  # whoever reads it says so
                yield from _named_files(read_bytes(path), path)


class Lines:
    """A file of JSON lines, of which empty ones are passed over."""

    def __init__(self, path: Path) -> None:
        self._path = path
        digest, place = hashlib.sha256(), 0
        starts, numbers = array("q"), array("q")  # of hundreds of thousands of lines
        with open_input(path) as file:
            for number, line in enumerate(file, start=1):
                digest.update(line)
                if number == 1 and line.startswith(BOM_UTF8):  # as programs of Windows write
                    place = len(BOM_UTF8)
                    line = line[place:]
                if line.strip():
                    starts.append(place)
                    numbers.append(number)
                place += len(line)
        starts.append(place)
        self._starts, self._numbers = starts, numbers
        self._digest = digest.hexdigest()[:16]

    def __len__(self) -> int:
        return len(self._numbers)

    def tasks(self, first: int, last: int) -> list[ObservationTask]:
        with open_input(self._path) as file:
            file.seek(self._starts[first])
            content = file.read(self._starts[last] - self._starts[first])
        lines = [line for line in content.split(b"\n") if line.strip()]
        numbered = zip(range(first, last), self._numbers[first:last], lines, strict=True)
        folder = _folder(self._path)
        return [
            ObservationTask(row, f"{self._path}, line {number}", line, folder)
            for row, number, line in numbered
        ]

    def fingerprint(self) -> str:
        return self._digest

    def named_files(self) -> Iterator[Path]:
        with open_input(self._path) as file:
            for line in file:
                yield from _named_files(line.removeprefix(BOM_UTF8), self._path)


class Detections:
    """A detector's file, which memory holds whole; objects that cannot be read come last."""

    def __init__(self, path: Path) -> None:
        self._path = path
        bad: dict[str, DataError] = {}
        good = read_image_keypoints(path, problems=bad)
        self._objects: list[tuple[str, ImageKeypoints | DataError]] = []
        self._objects += [(found.source, found) for found in good]
        self._objects += bad.items()

    def __len__(self) -> int:
        return len(self._objects)

    def tasks(self, first: int, last: int) -> list[ObservationTask]:
        chosen = enumerate(self._objects[first:last], start=first)
        folder = _folder(self._path)
        return [ObservationTask(row, name, found, folder) for row, (name, found) in chosen]

    def fingerprint(self) -> str:
        return fingerprint(read_bytes(self._path))

    def named_files(self) -> Iterable[Path]:
        return ()


Source = Files | Lines | Detections


class ObservationTasks(Sequence[ObservationTask]):
    """The observations of all inputs."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._sources = sources
        self._ends = list(accumulate(map(len, sources)))
        self.has_detections = any(isinstance(source, Detections) for source in sources)

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, place: Any) -> Any:
        if not isinstance(place, slice):
            row = range(len(self))[place]
            return self[row : row + 1][0]
        first, last, _ = place.indices(len(self))
        found: list[ObservationTask] = []
        index = bisect_right(self._ends, first)
        while first < last:
            source, end = self._sources[index], self._ends[index]
            start, stop = end - len(source), min(last, end)
            own = source.tasks(first - start, stop - start)
            found += [task._replace(row=task.row + start) for task in own]
            first, index = stop, index + 1
        return found

    def fingerprint(self) -> str:
        """A text that changes with the content of the inputs."""
        return fingerprint("\n".join(source.fingerprint() for source in self._sources))

    def named_files(self) -> tuple[Path, ...]:
        """Photos, masks and meshes that the observations name, each once."""
        found = (path for source in self._sources for path in source.named_files())
        return tuple(dict.fromkeys(found))


def read_sources(inputs: Iterable[Path]) -> ObservationTasks:
    """Find the observations of inputs.

    Raises DataError if a file cannot be read, or an input holds no observation.
    """
    sources: list[Source] = []
    for path in inputs:
        for source in _sources_of(path):
            last = sources[-1] if sources else None
            if isinstance(source, Files) and isinstance(last, Files):
                last.extend(source)  # thousands may be given, or match a pattern
            else:
                sources.append(source)
    return ObservationTasks(sources)


def _sources_of(path: Path) -> list[Source]:
    if path.is_dir():
        return _of_folder(path)
    if is_pattern(path):
        found = [Path(name) for name in sorted(glob(str(path), recursive=True))]
        if not found:
            raise DataError("no file matches", where=str(path))
        return [source for each in found for source in _sources_of(each)]
    return [_of_file(path)]


def _of_folder(folder: Path) -> list[Source]:
    """The observations of a folder, whose other JSON files are passed over."""
    files = [path for path in listed(folder) if path.is_file()]
    lines: list[Source] = [Lines(path) for path in files if path.suffix.lower() in LINES]
    single = [path for path in files if path.suffix.lower() == ".json"]
    found = [path for path in single if _kind_of_file(path) in (OBSERVATION, _DAMAGED)]
    if not found and not lines:
        raise DataError(
            "the folder holds no observation",
            where=str(folder),
            fix="`cadalign annotate` and `cadalign observe --every` write them",
        )
    return [Files(found), *lines] if found else lines


def _of_file(path: Path) -> Source:
    suffix = path.suffix.lower()
    if suffix in LINES:
        lines = Lines(path)
        if not len(lines):
            raise DataError("the file holds no observation", where=str(path))
        return lines
    kind = DETECTOR if suffix == TABLE else _kind_of_file(path)
    if kind == DETECTOR:
        return Detections(path)
    if kind != OBSERVATION:
        refuse_other_file(path, OBSERVATION)
    return Files([path])


def _named_files(content: bytes, path: Path) -> list[Path]:
    try:
        return list(named_files(msgspec.json.decode(content), path.parent))
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return []


def _folder(path: Path) -> str:
    """The folder of a file, the same for a worker that was started elsewhere."""
    return str(path.absolute().parent)


def _kind_of_file(path: Path) -> str | None:
    kinds = dict[str, msgspec.Raw] | list[msgspec.Raw]
    try:
        return kind_of(msgspec.json.decode(read_bytes(path), type=kinds))
    except msgspec.ValidationError:
        return _DAMAGED
    except (DataError, msgspec.MsgspecError, UnicodeError, RecursionError):
        pass
    try:
        return kind_of(read_json(path))  # slower, but knows the NaN that Python's JSON has
    except DataError:
        return _DAMAGED
