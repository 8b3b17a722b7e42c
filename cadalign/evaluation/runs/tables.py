"""Tables of a run: Parquet files whose bytes follow from their rows alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cadalign.errors import DataError, brief
from cadalign.io.files import write_whole

Row = dict[str, Any]
"""Cells of a table by column; what is missing or None is an empty cell."""
Columns = tuple[tuple[str, type], ...]
"""Names of a table's columns and their types: str, int, float or bool."""

# A table's row groups must not show in which pieces its rows came.
ROW_GROUP = 1 << 16
_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


def schema_of(columns: Columns) -> pa.Schema:
    """The Parquet schema of a table."""
    return pa.schema([(name, _TYPES[kind]) for name, kind in columns])


def write_rows(path: Path, columns: Columns, rows: Sequence[Row]) -> None:
    """Write rows as a Parquet file, whole or not at all."""
    table = pa.Table.from_pylist(list(rows), schema=schema_of(columns))
    write_tables(path, columns, [table])


def write_tables(path: Path, columns: Columns, tables: Iterable[pa.Table]) -> None:
    """Write one Parquet file of successive tables, holding few of them in memory at a time."""

    def write(unfinished: Path) -> None:
        with pq.ParquetWriter(unfinished, schema_of(columns), compression="zstd") as writer:
            for group in _regrouped(tables):
                writer.write_table(group, row_group_size=ROW_GROUP)

    write_whole(path, write)


def read_table(path: Path) -> pa.Table:
    """Read a Parquet file."""
    try:
        # Threads would gain nothing here and cost memory for each.
        return pq.read_table(path, use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise DataError(
            f"not a table that can be read ({brief(error)})",
            where=str(path),
            fix="remove it and start the same run again",
        ) from None


def _regrouped(tables: Iterable[pa.Table]) -> Iterator[pa.Table]:
    """The same rows in tables of `ROW_GROUP` rows, the last one shorter."""
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
