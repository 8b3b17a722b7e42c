"""Files of shape models.

A file is a sealed MessagePack document; see `cadalign.io.files` for the header. It holds the fields
of `cadalign.ShapeModel` and its parts. Arrays are stored as shape and little-endian numbers,
in single precision if that loses nothing.
"""

from __future__ import annotations

import math
import os
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta

from cadalign.errors import InputError
from cadalign.io.documents import Count, Document, PathText
from cadalign.io.files import Seal, as_path, read_bytes

Kind = TypeVar("Kind")
SEAL = Seal(
    magic=b"cadalign shape\n\0",
    version=1,
    noun="shape file",
    fix="learn it with: cadalign shape learn",
)
_MAX_BYTES = 1 << 30  # enough for thousands of models with hundreds of keypoints each


class _Array(Document):
    """An array of little-endian numbers in C order, of 4 or 8 bytes each."""

    shape: Annotated[list[Count], Meta(max_length=3)]
    data: bytes


def write_shape(path: str | os.PathLike[str], model: Any) -> None:
    """Write a shape model's file atomically."""
    document = {each.name: getattr(model, each.name) for each in fields(model)}
    try:
        content = msgspec.msgpack.encode(document, enc_hook=_encode)
    except (UnicodeEncodeError, OverflowError) as error:  # a name, an integer id
        raise InputError(f"cannot be saved ({error})", where=model.category) from None
    SEAL.write(as_path(path), content)


def read_shape(path: str | os.PathLike[str], kind: type[Kind]) -> Kind:
    """Read and check a shape model's file; ``kind`` is `cadalign.ShapeModel`."""
    file = as_path(path)
    payload = SEAL.unwrap(read_bytes(file, most=_MAX_BYTES), str(file))
    try:
        document = msgspec.msgpack.decode(payload)
        return msgspec.convert(document, kind, dec_hook=_decode)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise SEAL.error(f"is invalid: {str(error)[:200]}", str(file)) from None


def _encode(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    single = value.astype("<f4")
    little = single if np.array_equal(single, value, equal_nan=True) else value.astype("<f8")
    return _Array(list(value.shape), little.tobytes())


def _decode(kind: Any, value: Any) -> Any:
    try:
        if kind is Path:
            return Path(msgspec.convert(value, PathText))
        array = msgspec.convert(value, _Array)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from None  # msgspec adds the field's path
    size = math.prod(array.shape)
    if len(array.data) not in (4 * size, 8 * size):
        raise InputError(f"{len(array.data)} bytes do not fit the shape {array.shape}")
    stored = "<f4" if len(array.data) == 4 * size else "<f8"
    dtype = np.dtype(get_args(get_args(kind)[1])[0])
    return np.frombuffer(array.data, dtype=stored).reshape(array.shape).astype(dtype)
