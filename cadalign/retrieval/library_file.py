"""File format of libraries: a header of 64 bytes, then a memory-mapped Arrow table.

The header holds, in little-endian order::

    16 bytes   the text "cadalign library"
     4 bytes   version of the format
     4 bytes   zero
     8 bytes   length of the payload
    32 bytes   BLAKE2b checksum of the payload

The payload is an Arrow IPC file of the columns of `cadalign.retrieval.models.SCHEMA`. Opening maps
it into memory and compares the checksum, which reads the file once: 50,000 models of 10 keypoints
are 30 MB and take some 0.1 s. Processes that open the same file share its memory.
"""

from __future__ import annotations

import hashlib
import os
import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadalign.errors import DataError
from cadalign.io.files import write_whole
from cadalign.retrieval.models import SCHEMA, ModelTable

VERSION = 1
_MAGIC = b"cadalign library"
_HEADER = struct.Struct("<16sIIQ32s")
_AGAIN = "build it with: cadalign library build"


def write_library(path: str | os.PathLike[str], models: ModelTable) -> None:
    """Write a library's file atomically."""
    payload = _payload(models)
    header = _HEADER.pack(_MAGIC, VERSION, 0, payload.size, _checksum(payload))
    write_whole(Path(path), lambda unfinished: unfinished.write_bytes(header + payload))


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
    if content.size < _HEADER.size or content.slice(0, 16).to_pybytes() != _MAGIC:
        raise DataError("not a library file", where=where, fix=_AGAIN)
    _, version, _, size, checksum = _HEADER.unpack(content.slice(0, _HEADER.size).to_pybytes())
    if version != VERSION:
        raise DataError(
            f"a library file of version {version}, but this cadalign reads version {VERSION}",
            where=where,
            fix=_AGAIN,
        )
    payload = content.slice(_HEADER.size)
    if payload.size != size:
        what = "truncated" if payload.size < size else "too long"
        raise DataError(
            f"the library file is {what}: {payload.size} bytes, {size} expected",
            where=where,
            fix=f"copy it again, or {_AGAIN}",
        )
    if _checksum(payload) != checksum:
        raise DataError(
            "the library file is damaged: its checksum is wrong",
            where=where,
            fix=f"copy it again, or {_AGAIN}",
        )
    try:
        with pa.ipc.open_file(pa.BufferReader(payload)) as reader:
            table = reader.read_all()
        _check_table(table)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise DataError(
            f"the library file is invalid: {str(error)[:200]}", where=where, fix=_AGAIN
        ) from None
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
        if not np.isfinite(values.to_numpy()).all():
            raise ValueError("a coordinate is NaN or infinite")
    keys = list(zip(table["category"].to_pylist(), table["model_id"].to_pylist(), strict=True))
    if keys != sorted(set(keys)):
        raise ValueError("models are not sorted by category and id")


def fingerprint(models: ModelTable) -> str:
    """Hash of all content of a library, as text."""
    return _checksum(_payload(models)).hex()


def _payload(models: ModelTable) -> pa.Buffer:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, SCHEMA) as writer:
        writer.write_table(models.table)
    return sink.getvalue()


def _checksum(payload: pa.Buffer) -> bytes:
    return hashlib.blake2b(payload, digest_size=32).digest()
