"""Tables of runs as reproducible Parquet files, and `Run`, which reads them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, quote
from cadalign.evaluation.metrics import Metric, metric_named
from cadalign.evaluation.options import name_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import COLUMNS, Columns, Row
from cadalign.io.documents import convert, name_file
from cadalign.io.files import write_whole

DONE_ANEW = "remove it and start the same run again: it is computed again"
# Rows per group, so that a file does not depend on the chunks.
ROW_GROUP = 1 << 12
_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
Cells = dict[str, npt.NDArray[Any]]
"""Columns of a table, by name."""
SECONDS: Columns = (("seconds", float),)
_TIMINGS_FIX = "remove it: the run is shown without times"
_RECORDS_FIX = "remove it: the run is shown without its instances"
_FIX = "give a folder that cadalign demo, evaluate or simulate has written"


def schema_of(columns: Columns) -> pa.Schema:
    """The Parquet schema of a table."""
    return pa.schema([(name, _TYPES[kind]) for name, kind in columns])


def write_rows(path: Path, columns: Columns, rows: Sequence[Row]) -> None:
    """Write rows as a Parquet file, atomically."""
    table = pa.Table.from_pylist(list(rows), schema=schema_of(columns))
    write_tables(path, columns, [table])


def write_tables(path: Path, columns: Columns, tables: Iterable[pa.Table]) -> None:
    """Write successive tables to one Parquet file, with few of them in memory at a time."""

    def write(unfinished: Path) -> None:
        with pq.ParquetWriter(unfinished, schema_of(columns), compression="zstd") as writer:
            for group in _regroup(tables):
                writer.write_table(group, row_group_size=ROW_GROUP)

    write_whole(path, write)


def read_table(path: Path, *, fix: str = DONE_ANEW) -> pa.Table:
    """Read a Parquet file; ``fix`` is the advice of errors."""
    with _convert_errors(path, fix):
        # Threads would only cost memory.
        table = pq.read_table(path, use_threads=False)
        # Invalid UTF-8 in names raises only on access; older pyarrow ignores it in the schema.
        str((table.column_names, table.schema))
        table.validate(full=True)
        return table


def read_cells(path: Path, columns: Columns, *, is_record: bool = False) -> pa.Table:
    """Read columns of a chunk; with ``is_record``, only rows with a cell in the last column."""
    with _convert_errors(path, DONE_ANEW):
        names = [name for name, _ in columns]
        table = pq.read_table(path, columns=names, use_threads=False)
        if table.schema != schema_of(columns):
            raise DataError("not a valid table of a run", where=str(path), fix=DONE_ANEW)
        return table.filter(table[names[-1]].is_valid()) if is_record else table


def read_groups(path: Path, *, fix: str) -> Iterator[pa.Table]:
    """Read a Parquet file one row group at a time; raises the errors of `read_table`."""
    with _convert_errors(path, fix), pq.ParquetFile(path) as file:
        for index in range(file.num_row_groups):
            table = file.read_row_group(index, use_threads=False)
            table.validate(full=True)
            yield table


@contextmanager
def _convert_errors(path: Path, fix: str) -> Iterator[None]:
    try:
        yield
    except (OSError, UnicodeError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:200]
        what = f"the table cannot be read ({reason})"
        raise DataError(what, where=str(path), fix=fix) from None


def check_table(table: pa.Table, columns: Columns, *, path: Path, fix: str) -> pa.Table:
    """Check a table and return it.

    Raises DataError if a column is missing or has a wrong type, or a text is missing.
    """
    for name, kind in columns:
        what, wanted = "", _TYPES[kind]
        if name not in table.column_names:
            what = f"column {name!r} is missing"
        elif table.schema.field(name).type != wanted:
            found = quote(str(table.schema.field(name).type))
            what = f"column {name!r} has the type {found}, not {str(wanted)!r}"
        elif kind is str and table[name].null_count:
            what = f"column {name!r} has empty cells"
        if what:
            raise DataError(f"not a valid table of a run: {what}", where=str(path), fix=fix)
    return table


def _regroup(tables: Iterable[pa.Table]) -> Iterator[pa.Table]:
    """Split the rows into tables of `ROW_GROUP` rows; the last one may be shorter."""
    waiting: list[pa.Table] = []
    count = 0
    for table in tables:
        waiting.append(table)
        count += len(table)
        while count >= ROW_GROUP:
            joined = pa.concat_tables(waiting)
            yield joined.slice(0, ROW_GROUP).combine_chunks()
            waiting = [joined.slice(ROW_GROUP)]
            count -= ROW_GROUP
    if count:
        yield pa.concat_tables(waiting).combine_chunks()


@dataclass(frozen=True, eq=False)
class Run:
    """A run with the results so far: ``done`` of ``total`` tasks are finished.

    ``name`` distinguishes it from other runs, ``config`` is the content of ``run.json``, and
    ``seconds`` (n,) are the times of the rows, NaN if unknown.
    """

    folder: RunFolder
    name: str
    config: dict[str, Any]
    results: pa.Table
    seconds: FloatArray
    done: int
    total: int

    @classmethod
    def open(cls, path: Path, name: str | None = None, *, columns: Columns = COLUMNS) -> Self:
        """Read a run; raises DataError if its result table lacks one of the columns."""
        folder, name = RunFolder(path), path.name if name is None else name
        config = folder.read_config() if path.is_dir() else None
        if config is None:
            what = (
                "not the folder of a run: it has no run.json" if path.is_dir() else "no such folder"
            )
            raise DataError(what, where=str(path), fix=_FIX)
        total, size = int(config.get("tasks", 0)), int(config.get("chunk_size", 1))
        if folder.is_finished:
            table = read_table(folder.results)
            results = check_table(table, columns, path=folder.results, fix=DONE_ANEW)
            return cls(folder, name, config, results, _times(folder, len(results)), total, total)
        parts = [index for index in _parts(folder) if index * size < total]
        if not parts:
            fix = "wait, or start the same command again: the run continues"
            raise DataError("nothing of the run is finished yet", where=str(path), fix=fix)
        done = sum(min(size, total - index * size) for index in parts)
        table = _join([folder.part(index) for index in parts], (*columns, *SECONDS))
        own = table.column_names[: table.column_names.index("seconds")]
        return cls(folder, name, config, table.select(own), _seconds(table), done, total)

    @property
    def experiment(self) -> str:
        """Name of the experiment, such as ``keypointnet``."""
        return str(self.config.get("experiment"))

    @property
    def is_finished(self) -> bool:
        """True once all rows are written."""
        return self.folder.is_finished

    @property
    def methods(self) -> list[str]:
        """Names of the methods in the run's order."""
        return list(dict.fromkeys(self.results["method"].to_pylist()))

    @cached_property
    def metrics(self) -> tuple[Metric, ...]:
        """Metrics of users' functions, from the run's configuration."""
        with name_file(self.folder.config_file):
            functions = convert(self.config.get("metrics") or (), tuple[str, ...], "metrics")
        return tuple(metric_named(name_of(each)) for each in functions)

    @property
    def dataset(self) -> str:
        """Name of the dataset's folder; empty without a dataset."""
        return PurePath(str(self.config.get("root") or self.config.get("path") or "")).name

    @property
    def day(self) -> str:
        """Day of the start (UTC), such as 2026-03-01."""
        seconds = self.folder.config_file.stat().st_mtime
        return time.strftime("%Y-%m-%d", time.gmtime(seconds))

    @cached_property
    def cells(self) -> Cells:
        """Columns of the results, and ``seconds``, NaN if unknown."""
        cells: Cells = {
            name: np.asarray(self.results[name].to_numpy(zero_copy_only=False))
            for name in self.results.column_names
        }
        return {**cells, "seconds": self.seconds}

    def records(self, columns: Columns) -> Iterator[dict[str, Any]]:
        """Rows of the table of instance records; none for runs without records."""
        for path in self._record_files():
            for table in read_groups(path, fix=_RECORDS_FIX):
                if not self.is_finished and columns[-1][0] in table.column_names:
                    table = table.filter(table[columns[-1][0]].is_valid())
                yield from check_table(table, columns, path=path, fix=_RECORDS_FIX).to_pylist()

    def _record_files(self) -> list[Path]:
        whole = self.folder.records
        if self.is_finished:
            return [whole] if whole.is_file() else []
        return [self.folder.part(index) for index in _parts(self.folder)]


def _times(folder: RunFolder, count: int) -> FloatArray:
    """The times of a finished run's rows, NaN if unknown."""
    if folder.timings.is_file():
        timings = read_table(folder.timings, fix=_TIMINGS_FIX)
        timings = check_table(timings, SECONDS, path=folder.timings, fix=_TIMINGS_FIX)
        if len(timings) == count:
            return _seconds(timings)
    return np.full(count, np.nan)


def _seconds(table: pa.Table) -> FloatArray:
    return np.asarray(table["seconds"].to_numpy(zero_copy_only=False), dtype=float)


def _parts(folder: RunFolder) -> list[int]:
    """Indices of the finished chunks, in order."""
    names = (path.stem for path in folder.parts.glob("*.parquet"))
    return sorted(int(name) for name in names if name.isdecimal())


def _join(paths: Sequence[Path], columns: Columns) -> pa.Table:
    tables = [check_table(read_table(path), columns, path=path, fix=DONE_ANEW) for path in paths]
    for path, table in zip(paths, tables, strict=True):
        if table.schema != tables[0].schema:
            what = f"its columns differ from the columns of {paths[0].name}"
            raise DataError(what, where=str(path), fix=DONE_ANEW)
    return pa.concat_tables(tables)
