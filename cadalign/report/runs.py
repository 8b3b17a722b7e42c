"""The runs that a report is about: read from their folders, finished or not."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from cadalign.errors import DataError, InputError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_table

INSTANCES = "instances"
"""Runs over views of models: what a gallery can show."""
SIMULATION = "simulation"
CORRESPONDENCES = "correspondences"
RETRIEVAL = "retrieval"
_FAMILIES = {
    "keypointnet": INSTANCES,
    "demo": INSTANCES,
    "simulate": SIMULATION,
    "correspondences": CORRESPONDENCES,
    "retrieval": RETRIEVAL,
}
_FIX = "give a folder that cadalign demo, evaluate or simulate has written"


@dataclass(frozen=True, eq=False)
class Run:
    """A run with its tables.

    Parameters
    ----------
    folder : RunFolder
    name : str
        What to call it beside others.
    config : dict
        What ``run.json`` holds.
    results : pyarrow.Table
        The rows that there are.
    timings : pyarrow.Table
        The seconds of the same rows; empty where they were not kept.
    done, total : int
        Tasks.
    """

    folder: RunFolder
    name: str
    config: dict[str, Any]
    results: pa.Table
    timings: pa.Table
    done: int
    total: int

    @property
    def experiment(self) -> str:
        """What made it, such as ``keypointnet`` or ``simulate``."""
        return str(self.config["experiment"])

    @property
    def family(self) -> str:
        """Runs of one family go into one report."""
        return _FAMILIES[self.experiment]

    @property
    def is_finished(self) -> bool:
        """Whether all its rows are there."""
        return self.folder.is_finished

    @property
    def methods(self) -> list[str]:
        """The methods' names in the run's order."""
        return list(dict.fromkeys(self.results["method"].to_pylist()))

    @property
    def noise_px(self) -> float | None:
        """Standard deviation of the keypoints' noise [px], where it is one."""
        noise = self.config.get("noise_px")
        return float(noise) if isinstance(noise, int | float) else None

    @property
    def day(self) -> str:
        """The day on which it was begun, such as 2026-03-01 (UTC)."""
        try:
            return str(json.loads(self.folder.progress.read_text(encoding="utf-8"))["started"])[:10]
        except (OSError, ValueError, KeyError, TypeError):  # a demo has none
            seconds = self.folder.config_file.stat().st_mtime
            return time.strftime("%Y-%m-%d", time.gmtime(seconds))

    def exhibits(self) -> Iterator[dict[str, Any]]:
        """The rows of its table of exhibits that there are; none of runs that keep none."""
        for path in self._exhibit_files():
            yield from read_table(path).to_pylist()

    def exhibit_bytes(self) -> int:
        """How much text the exhibits are, roughly."""
        import pyarrow.parquet as pq

        count = 0
        for path in self._exhibit_files():
            metadata = pq.read_metadata(path)
            groups = (metadata.row_group(index) for index in range(metadata.num_row_groups))
            count += sum(group.total_byte_size for group in groups)
        return count

    def _exhibit_files(self) -> list[Path]:
        whole = self.folder.exhibits
        if self.is_finished:
            return [whole] if whole.is_file() else []
        return [path for _, path in _parts(self.folder, self.folder.part_exhibits)]


def read_runs(folders: Sequence[str | os.PathLike[str]]) -> list[Run]:
    """Read runs that go into one report.

    Parameters
    ----------
    folders : sequence of path-like

    Raises
    ------
    InputError
        If there are none, one is given twice, or they are of different kinds.
    DataError
        If a folder is not a run's, or nothing of a run is finished.
    """
    paths = [Path(folder) for folder in folders]
    if not paths:
        raise InputError("none is given", where="runs", fix=_FIX)
    seen: set[Path] = set()
    for path in paths:
        if path.resolve() in seen:
            raise InputError("the run is given twice", where=str(path))
        seen.add(path.resolve())
    runs = [_read(path, name) for path, name in zip(paths, _names(paths), strict=True)]
    for run in runs[1:]:
        if _kind(run) != _kind(runs[0]):
            raise InputError(
                f"{run.name} is a run of {_kind(run)}, {runs[0].name} one of {_kind(runs[0])}",
                where="runs",
                fix="write a report for each kind",
            )
    return runs


def _kind(run: Run) -> str:
    """What runs must have in common to be compared, in words."""
    if run.family == SIMULATION:
        return f"cadalign simulate {run.config['sweep']['name']}"
    return "views of models" if run.family == INSTANCES else run.family


def _read(path: Path, name: str) -> Run:
    folder = RunFolder(path)
    if not path.is_dir():
        raise DataError("no such folder", where=str(path), fix=_FIX)
    config = folder.read_config()
    if config is None:
        raise DataError("not the folder of a run: it has no run.json", where=str(path), fix=_FIX)
    if config.get("experiment") not in _FAMILIES:
        raise DataError(
            f"there is no report on a run of {config.get('experiment')!r}",
            where=str(path),
            fix=f"known are {', '.join(_FAMILIES)}",
        )
    total = int(config.get("tasks", 0))
    if folder.is_finished:
        timings = [folder.timings] if folder.timings.is_file() else []
        return Run(folder, name, config, read_table(folder.results), _joined(timings), total, total)
    parts = _parts(folder, folder.part)
    if not parts:
        raise DataError(
            "nothing of the run is finished yet",
            where=str(path),
            fix="wait, or start the command that made it again: it goes on",
        )
    size = int(config.get("chunk_size", 1))
    done = sum(min(size, total - index * size) for index, _ in parts)
    timings = [folder.part_timings(index) for index, _ in parts]
    results = _joined([path for _, path in parts])
    return Run(folder, name, config, results, _joined(timings), done, total)


def _parts(folder: RunFolder, file_of: Callable[[int], Path]) -> list[tuple[int, Path]]:
    """The finished chunks with the files of one of their tables, in order."""
    names = (path.name.removesuffix(".parquet") for path in folder.parts.glob("*.parquet"))
    indices = sorted(int(name) for name in names if name.isdecimal())
    return [(index, file_of(index)) for index in indices if file_of(index).is_file()]


def _joined(paths: Sequence[Path]) -> pa.Table:
    """One table of several; empty, without columns, of none."""
    return pa.concat_tables([read_table(path) for path in paths]) if paths else pa.table({})


def _names(paths: Sequence[Path]) -> list[str]:
    """As few of the paths' last parts as tell them apart."""
    parts = [path.absolute().parts for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(some[-count:]) for some in parts]
        if len(set(names)) == len(names):
            break
    return names
