"""File format of libraries: a sealed Arrow table, mapped into memory.

See `cadalign.io.files` for the header. The payload is an Arrow IPC file of the columns of
`cadalign.retrieval.models.SCHEMA`. Opening maps it into memory and compares the checksum, which
reads the file once: 50,000 models of 10 keypoints are 30 MB and take some 0.1 s. Processes that
open the same file share its memory.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadalign.errors import DataError
from cadalign.io.files import Seal, checksum
from cadalign.retrieval.models import SCHEMA, ModelTable

_AGAIN = "build it with: cadalign library build"
_LARGEST = 1e50  # coordinate
SEAL = Seal(magic=b"cadalign library", version=1, noun="library file", fix=_AGAIN)


def write_library(path: str | os.PathLike[str], models: ModelTable) -> None:
    """Write a library's file atomically."""
    SEAL.write(Path(path), _payload(models))


def read_library(path: str | os.PathLike[str]) -> ModelTable:
    """Map a library's file into memory and check it."""
    where = str(path)
    try:
        # Opening a pipe would wait for its other end.
        if Path(path).exists() and not Path(path).is_file():
            raise OSError("not a regular file")
        with pa.memory_map(where) as source:
            content = source.read_buffer()
    except FileNotFoundError:
        raise DataError("no such library file", where=where, fix=_AGAIN) from None
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"cannot be read ({error})", where=where) from None
    payload = SEAL.unwrap(content, where)
    try:
        with pa.ipc.open_file(pa.BufferReader(pa.py_buffer(payload))) as reader:
            table = reader.read_all()
        _check_table(table)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise SEAL.error(f"is invalid: {str(error)[:200]}", where) from None
    return ModelTable(table)


def _check_table(table: pa.Table) -> None:
    """Refuse a table whose indices could lead out of its memory, whatever its checksum."""
    if not table.schema.equals(SCHEMA):
        raise ValueError("it has other columns")
    table.validate(full=True)
    for name in table.column_names:
        column = table[name]
        while column is not None:
            if column.null_count and name != "mesh":
                raise ValueError(f"{name} is missing for a model")
            is_nested = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
            column = pc.list_flatten(column) if is_nested else None
    counts = pc.list_value_length(table["semantic_ids"]).to_numpy()
    if (pc.list_value_length(table["keypoints"]).to_numpy() != counts).any():
        raise ValueError("keypoints and semantic_ids differ in length")
    labels = pc.list_value_length(table["labelings"]).to_numpy()
    if (labels % np.maximum(counts, 1)).any():
        raise ValueError("labelings are not rows of all keypoints")
    rows = pc.list_flatten(table["labelings"]).to_numpy()
    if ((rows < 0) | (rows >= np.repeat(counts, labels))).any():
        raise ValueError("a labeling names a keypoint that does not exist")
    for numbers in (pc.list_flatten(pc.list_flatten(table["keypoints"])), table["bounds"]):
        values = numbers if pa.types.is_floating(numbers.type) else pc.list_flatten(numbers)
        if not (np.abs(values.to_numpy()) < _LARGEST).all():
            raise ValueError("a coordinate is NaN, infinite or so large that its powers are")
    keys = list(zip(table["category"].to_pylist(), table["model_id"].to_pylist(), strict=True))
    if keys != sorted(set(keys)):
        raise ValueError("models are not sorted by category and id")


def fingerprint(models: ModelTable) -> str:
    """Hash of all content of a library, as text."""
    return checksum(_payload(models)).hex()


def _payload(models: ModelTable) -> pa.Buffer:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, SCHEMA) as writer:
        writer.write_table(models.table)
    return sink.getvalue()
