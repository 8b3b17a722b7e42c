"""Runs read from their folders, finished or not."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from cadalign.arrays import is_number
from cadalign.errors import DataError
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import (
    DONE_ANEW,
    Columns,
    checked,
    read_groups,
    read_table,
    uncompressed_bytes,
)
from cadalign.evaluation.runs.work import COLUMNS
from cadalign.io.documents import convert, in_file, read_json

Cells = dict[str, npt.NDArray[Any]]
"""Columns of a table by name."""
_SECONDS: Columns = (("seconds", float),)
_NO_TIMINGS = pa.table({})
_TIMINGS_FIX = "remove it: the run is shown without times"
_RECORDS_FIX = "remove it: the run is shown without its instances"
_FIX = "give a folder that cadalign demo, evaluate or simulate has written"


@dataclass(frozen=True, eq=False)
class Run:
    """A run with its tables: the rows that there are, of so many tasks that are done.

    ``name`` is its name beside others, ``config`` the content of ``run.json``; ``timings`` is empty
    where times were not kept.
    """

    folder: RunFolder
    name: str
    config: dict[str, Any]
    results: pa.Table
    timings: pa.Table
    done: int
    total: int

    @classmethod
    def open(cls, path: Path, name: str | None = None, *, columns: Columns = COLUMNS) -> Self:
        """Read a run, whose result table must have these columns; see `checked`."""
        folder = RunFolder(path)
        if not path.is_dir():
            raise DataError("no such folder", where=str(path), fix=_FIX)
        config = folder.read_config()
        if config is None:
            raise DataError(
                "not the folder of a run: it has no run.json", where=str(path), fix=_FIX
            )
        name = path.name if name is None else name
        total = int(config.get("tasks", 0))
        if folder.is_finished:
            results, timings = _finished(folder, columns)
            return cls(folder, name, config, results, timings, total, total)
        size = int(config.get("chunk_size", 1))
        parts = [index for index in _parts(folder, folder.results) if index * size < total]
        if not parts:
            raise DataError(
                "nothing of the run is finished yet",
                where=str(path),
                fix="wait, or start the command that made it again: it goes on",
            )
        done = sum(min(size, total - index * size) for index in parts)
        results = _joined([folder.part(folder.results, index) for index in parts], columns)
        files = [folder.part(folder.timings, index) for index in parts]
        timings = _joined(files, _SECONDS) if all(map(Path.is_file, files)) else _NO_TIMINGS
        return cls(folder, name, config, results, timings, done, total)

    @property
    def experiment(self) -> str:
        """Name of the experiment, such as ``keypointnet``."""
        return str(self.config.get("experiment"))

    @property
    def is_finished(self) -> bool:
        """True once all rows are there."""
        return self.folder.is_finished

    @property
    def methods(self) -> list[str]:
        """Names of the methods in the run's order."""
        return list(dict.fromkeys(self.results["method"].to_pylist()))

    @cached_property
    def metrics(self) -> tuple[Metric, ...]:
        """Registered metrics, as the run's configuration describes them."""
        with in_file(self.folder.config_file):
            return convert(self.config.get("metrics") or (), tuple[Metric, ...], "metrics")

    @property
    def noise_px(self) -> float | None:
        """Standard deviation of the keypoints' noise [px], if it is one number."""
        noise: Any = self.config.get("noise_px")
        return float(noise) if is_number(noise) else None

    @property
    def dataset(self) -> str:
        """Name of the dataset's folder."""
        path = PurePath(str(self.config.get("root") or self.config.get("path") or ""))
        return path.name or "an unknown dataset"

    @property
    def day(self) -> str:
        """Day of its start, such as 2026-03-01 (UTC)."""
        try:
            return str(read_json(self.folder.progress)["started"])[:10]
        except (DataError, KeyError, TypeError):
            seconds = self.folder.config_file.stat().st_mtime
            return time.strftime("%Y-%m-%d", time.gmtime(seconds))

    @cached_property
    def cells(self) -> Cells:
        """Columns of the results, and ``seconds``, NaN where they were not kept."""
        cells = {name: self.column(name) for name in self.results.column_names}
        seconds = np.full(len(self.results), np.nan)
        if len(self.timings) == len(self.results):
            seconds = self.timings["seconds"].to_numpy(zero_copy_only=False).astype(float)
        return {**cells, "seconds": seconds}

    def column(self, name: str) -> npt.NDArray[Any]:
        """A column of the results."""
        return np.asarray(self.results[name].to_numpy(zero_copy_only=False))

    def count(self, *names: str) -> int:
        """Number of different values of some columns."""
        return len(self.results.select(names).group_by(list(names)).aggregate([]))

    def records(self, columns: Columns) -> Iterator[dict[str, Any]]:
        """Rows of the table of instance records; none of runs that keep none."""
        for path in self._record_files():
            for table in read_groups(path, fix=_RECORDS_FIX):
                yield from checked(table, columns, path=path, fix=_RECORDS_FIX).to_pylist()

    def record_bytes(self) -> int:
        """Rough size of the instance records."""
        count = 0
        for path in self._record_files():
            count += uncompressed_bytes(path, fix=_RECORDS_FIX)
        return count

    def _record_files(self) -> list[Path]:
        folder, whole = self.folder, self.folder.records
        if self.is_finished:
            return [whole] if whole.is_file() else []
        return [folder.part(whole, index) for index in _parts(folder, whole)]


def _parts(folder: RunFolder, table: Path) -> list[int]:
    """The finished chunks that have a part of a table, in order."""
    names = (path.name.removesuffix(".parquet") for path in folder.parts.glob("*.parquet"))
    indices = sorted(int(name) for name in names if name.isdecimal())
    return [index for index in indices if folder.part(table, index).is_file()]


def _finished(folder: RunFolder, columns: Columns) -> tuple[pa.Table, pa.Table]:
    """The results and the timings of a finished run; the latter may have been removed."""
    path = folder.results
    results = checked(read_table(path), columns, path=path, fix=DONE_ANEW)
    path = folder.timings
    if not path.is_file():
        return results, _NO_TIMINGS
    return results, checked(
        read_table(path, fix=_TIMINGS_FIX), _SECONDS, path=path, fix=_TIMINGS_FIX
    )


def _joined(paths: Sequence[Path], columns: Columns) -> pa.Table:
    tables = [checked(read_table(path), columns, path=path, fix=DONE_ANEW) for path in paths]
    for path, table in zip(paths, tables, strict=True):
        if table.schema != tables[0].schema:
            what = f"its columns are not those of {paths[0].name}"
            raise DataError(what, where=str(path), fix=DONE_ANEW)
    return pa.concat_tables(tables)
