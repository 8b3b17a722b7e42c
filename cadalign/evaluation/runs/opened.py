"""Runs read from their folders, finished or not."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from cadalign.errors import CadalignError, DataError, brief
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_table

Cells = dict[str, npt.NDArray[Any]]
"""Columns of a table by name."""
_FIX = "give a folder that cadalign demo, evaluate or simulate has written"


_NOT_AS_WRITTEN = (
    *(LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError),
    pa.ArrowException,
)


@contextmanager
def interpreting(*paths: str | os.PathLike[str]) -> Iterator[None]:
    """Convert errors on runs whose files cadalign did not write like that to `DataError`.

    Any value of ``run.json`` may be missing or something else then, any column of the tables too.
    """
    try:
        yield
    except CadalignError:
        raise
    except _NOT_AS_WRITTEN as error:
        reason = f"{type(error).__name__}: {brief(error)}"
        raise DataError(
            f"run.json or a table is not as cadalign writes it ({reason})",
            where=", ".join(str(path) for path in paths),
            fix="get the whole folder again, or repeat the run",
        ) from error


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
    def open(cls, path: Path, name: str | None = None) -> Run:
        """Read a run."""
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
            timings = [folder.timings] if folder.timings.is_file() else []
            results = read_table(folder.results)
            return cls(folder, name, config, results, _joined(timings), total, total)
        parts = _parts(folder, folder.results)
        if not parts:
            raise DataError(
                "nothing of the run is finished yet",
                where=str(path),
                fix="wait, or start the command that made it again: it goes on",
            )
        size = int(config.get("chunk_size", 1))
        done = sum(min(size, total - index * size) for index in parts)
        timings = [folder.part(folder.timings, index) for index in parts]
        results = _joined([folder.part(folder.results, index) for index in parts])
        return cls(folder, name, config, results, _joined(timings), done, total)

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

    @property
    def noise_px(self) -> float | None:
        """Standard deviation of the keypoints' noise [px], if it is one number."""
        noise = self.config.get("noise_px")
        return float(noise) if isinstance(noise, int | float) else None

    @property
    def dataset(self) -> str:
        """Name of the dataset's folder."""
        path = PurePath(str(self.config.get("root") or self.config.get("path") or ""))
        return path.name or "an unknown dataset"

    @property
    def day(self) -> str:
        """Day of its start, such as 2026-03-01 (UTC)."""
        try:
            return str(json.loads(self.folder.progress.read_text(encoding="utf-8"))["started"])[:10]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
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

    def records(self) -> Iterator[dict[str, Any]]:
        """Rows of the table of instance records; none of runs that keep none."""
        for path in self._record_files():
            yield from read_table(path).to_pylist()

    def record_bytes(self) -> int:
        """Rough size of the instance records."""
        count = 0
        for path in self._record_files():
            metadata = pq.read_metadata(path)
            groups = (metadata.row_group(index) for index in range(metadata.num_row_groups))
            count += sum(group.total_byte_size for group in groups)
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


def _joined(paths: Sequence[Path]) -> pa.Table:
    """One table of several; empty, without columns, of none."""
    return pa.concat_tables([read_table(path) for path in paths]) if paths else pa.table({})
