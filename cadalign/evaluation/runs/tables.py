"""Tables of a run: Parquet files whose bytes follow from their rows alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cadalign.errors import DataError, quote
from cadalign.io.files import write_whole

Row = dict[str, Any]
"""Cells of a table by column; what is missing or None is an empty cell."""
Columns = tuple[tuple[str, Any], ...]
"""Names of a table's columns and their types: str, int, float, bool, or list of one but int."""

DONE_ANEW = "remove it and start the same run again: what is missing is done anew"
# A table's row groups must not show in which pieces its rows came.
ROW_GROUP = 1 << 12
_TYPES = {
    str: pa.string(),
    int: pa.int64(),
    float: pa.float64(),
    bool: pa.bool_(),
    list[float]: pa.list_(pa.float64()),
    list[bool]: pa.list_(pa.bool_()),
    list[str]: pa.list_(pa.string()),
}


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


def read_table(path: Path, *, fix: str = DONE_ANEW) -> pa.Table:
    """Read a Parquet file; ``fix`` is what errors advise."""
    with _reading(path, fix):
        # Threads would gain nothing here and cost memory for each.
        table = pq.read_table(path, use_threads=False)
        str(table.schema)  # names that are no text are noticed when they are looked at
        table.validate(full=True)
        return table


def read_groups(path: Path, *, fix: str) -> Iterator[pa.Table]:
    """Read a Parquet file by its row groups, of which memory holds one at a time.

    Errors are those of `read_table`.
    """
    with _reading(path, fix), pq.ParquetFile(path) as file:
        for index in range(file.num_row_groups):
            table = file.read_row_group(index, use_threads=False)
            table.validate(full=True)
            yield table


def uncompressed_bytes(path: Path, *, fix: str) -> int:
    """Size of a Parquet file's content; errors are those of `read_table`."""
    with _reading(path, fix):
        metadata = pq.read_metadata(path)
        groups = (metadata.row_group(index) for index in range(metadata.num_row_groups))
        return sum(group.total_byte_size for group in groups)


@contextmanager
def _reading(path: Path, fix: str) -> Iterator[None]:
    try:
        yield
    except (OSError, UnicodeError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:200]
        what = f"not a table that can be read ({reason})"
        raise DataError(what, where=str(path), fix=fix) from None


def is_whole(path: Path, columns: Columns) -> bool:
    """True if a file is a table of exactly these columns and can be read to its end."""
    try:
        return bool(read_table(path).schema.equals(schema_of(columns)))
    except DataError:
        return False


def checked(table: pa.Table, columns: Columns, *, path: Path, fix: str) -> pa.Table:
    """The table of a file, with empty columns for numbers that an older one does not have.

    Raises DataError if another column is missing, a type is another, or a text is missing.
    """
    for name, kind in columns:
        what, wanted = "", _TYPES[kind]
        if name not in table.column_names:
            if kind is float:
                empty = pa.nulls(len(table), wanted)
                table = table.append_column(name, empty)
                continue
            what = f"there is no column {name!r}"
        elif table.schema.field(name).type != wanted:
            found = quote(str(table.schema.field(name).type))
            what = f"the column {name!r} is of the type {found}, not {str(wanted)!r}"
        elif kind is str and table[name].null_count:
            what = f"the column {name!r} has empty cells"
        if what:
            raise DataError(f"not a table of such a run: {what}", where=str(path), fix=fix)
    return table


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
