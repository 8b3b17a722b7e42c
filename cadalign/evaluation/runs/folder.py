"""Folder of a run: its files (docs/formats/runs.md), lock and configuration."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, field

from cadalign.errors import DataError
from cadalign.io.documents import Count, ForeignDocument, convert, name_file, read_json
from cadalign.io.files import create_folder, hold_lock, refuse_nul, write_json

_FORMAT = 1
_LONGEST_VALUE = 80
_MOST_DIFFERENCES = 6
_FIX = "give another folder (--out), or remove this one"
_FIX_FOREIGN = "rename it, or give another --out"
_LOCK = ".lock"
_WRITTEN = ("results.csv", "summary.csv", "report.html", "records.parquet", "timings.parquet")
"""Files of a run with names that other programs may use, too."""


class _PathInFolder:
    """The path of a file or folder inside a run's folder."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, folder: RunFolder, owner: type[RunFolder]) -> Path:
        return folder.path / self._name


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run."""

    path: Path

    config_file = _PathInFolder("run.json")
    results = _PathInFolder("results.parquet")
    timings = _PathInFolder("timings.parquet")
    records = _PathInFolder("records.parquet")
    summary = _PathInFolder("summary.csv")
    figures = _PathInFolder("figures")
    pictures = _PathInFolder("pictures")
    thumbs = _PathInFolder("thumbs")
    previews = _PathInFolder("previews")
    report = _PathInFolder("report.html")
    parts = _PathInFolder("parts")

    @property
    def is_finished(self) -> bool:
        """True once all results are written."""
        return self.results.is_file()

    @property
    def sources(self) -> tuple[Path, ...]:
        """The input files of pages and tables."""
        return self.config_file, self.results, self.timings, self.records

    def part(self, index: int) -> Path:
        """The file of a chunk's rows, with the columns of all tables."""
        return self.parts / f"{index:07d}.parquet"

    def make(self) -> None:
        """Create the folder."""
        create_folder(self.path)

    def made_for_pictures(self) -> RunFolder:
        """Create the folder and its folders for pictures; returns it with its absolute path."""
        self.make()
        for path in (self.thumbs, self.pictures, self.previews):
            create_folder(path)
        return RunFolder(self.path.absolute())

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the run against other processes; the lock of a killed process is released."""
        what = "another process is working on this run"
        with hold_lock(self.path / _LOCK, what, fix="wait for it, or give another folder (--out)"):
            yield

    def read_config(self) -> dict[str, Any] | None:
        """Read ``run.json``; None if it does not exist."""
        path = self.config_file
        refuse_nul(path)
        if not path.exists():
            return None
        found: dict[str, Any] = read_json(path)
        with name_file(path):
            convert(found, _Config)
        return found

    def claim(self, config: dict[str, Any]) -> None:
        """Write ``run.json``, or raise DataError if an existing one differs."""
        # The last bits of results depend on these versions.
        names = ("cadalign", "numpy", "scipy", "numba", "pyarrow")
        versions = {name: version(name) for name in names}
        versions |= {"python": platform.python_version(), "machine": platform.machine()}
        stated = {**config, "format": _FORMAT, "versions": versions}
        wanted = json.loads(json.dumps(stated))
        found = self.read_config()
        if found is None:
            if self.parts.exists() or self.results.exists():
                raise DataError("holds results but no run.json", where=str(self.path), fix=_FIX)
            foreign = next((name for name in _WRITTEN if (self.path / name).exists()), None)
            if foreign is not None:
                what = f"holds {foreign} but no {self.config_file.name}: not the folder of a run"
                raise DataError(what, where=str(self.path), fix=_FIX_FOREIGN)
            write_json(self.config_file, wanted)
            return
        differences = list(_differences(found, wanted))
        if differences:
            listed, rest = differences[:_MOST_DIFFERENCES], len(differences) - _MOST_DIFFERENCES
            more = f"; and {rest} more differences" if rest > 0 else ""
            what = f"the folder holds a run with another configuration: {'; '.join(listed)}{more}"
            raise DataError(what, where=str(self.path), fix=_FIX)


class _Config(ForeignDocument):
    """Fields of ``run.json`` that all experiments share."""

    experiment: str | None = None
    tasks: Count = 0
    chunk_size: Annotated[int, Meta(ge=1, le=2**63 - 1)] = 1
    versions: dict[str, Any] = field(default_factory=dict)


def _differences(found: Any, wanted: Any, name: str = "") -> Iterator[str]:
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in sorted({*found, *wanted}):
            inner = f"{name}.{key}" if name else key
            yield from _differences(found.get(key), wanted.get(key), inner)
    elif found != wanted:
        there, now = map(json.dumps, (found, wanted))
        yield f"{name} is {_shorten(there)} there and {_shorten(now)} now"


def _shorten(text: str) -> str:
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."
