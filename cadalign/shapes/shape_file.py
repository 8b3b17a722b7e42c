"""File format of shape models: a sealed MessagePack document.

See `cadalign.io.files` for the header. The document holds the fields of `cadalign.ShapeModel` and
of its parts, arrays as little-endian numbers with their shape.
"""

from __future__ import annotations

import math
import os
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta

from cadalign.errors import InputError
from cadalign.io.documents import Count, Document, PathText, in_file
from cadalign.io.files import Seal, as_path, read_bytes

Kind = TypeVar("Kind")
SEAL = Seal(
    magic=b"cadalign shape\n\0",
    version=1,
    noun="shape file",
    fix="learn it with: cadalign shape learn",
)
_MAX_BYTES = 1 << 30  # of thousands of models with hundreds of keypoints each


class _Array(Document):
    """Little-endian numbers in C order."""

    shape: Annotated[list[Count], Meta(max_length=3)]
    data: bytes


def write_shape(path: str | os.PathLike[str], model: Any) -> None:
    """Write a shape model's file atomically."""
    document = {each.name: getattr(model, each.name) for each in fields(model)}
    try:
        content = msgspec.msgpack.encode(document, enc_hook=_written)
    except (UnicodeEncodeError, OverflowError) as error:  # of a name, of a number as an id
        raise InputError(f"cannot be saved ({error})", where=model.category) from None
    SEAL.write(as_path(path), content)


def read_shape(path: str | os.PathLike[str], kind: type[Kind]) -> Kind:
    """Read and check a shape model's file; ``kind`` is `cadalign.ShapeModel`."""
    file = as_path(path)
    payload = SEAL.unwrap(read_bytes(file, most=_MAX_BYTES), str(file))
    try:
        document = msgspec.msgpack.decode(payload)
        model = msgspec.convert(document, kind, dec_hook=_read)
        _check_known(document, model)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        cause = error.__cause__
        if isinstance(cause, InputError) and str(cause) == str(error):  # of the model as a whole
            with in_file(file):
                raise cause from None
        what, _, place = str(error).partition(" - at `$.")
        join = "." if isinstance(cause, InputError) and cause.where else ": "
        what = f"{place.rstrip('`')}{join}{what}" if place else what
        raise SEAL.error(f"is invalid: {what[:200]}", str(file)) from None
    return model


def _written(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    little = value.astype(value.dtype.newbyteorder("<"))
    return _Array(list(value.shape), little.tobytes())


def _read(kind: Any, value: Any) -> Any:
    try:
        if kind is Path:
            return Path(msgspec.convert(value, PathText))
        array = msgspec.convert(value, _Array)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from None  # to which the library adds the place
    dtype = np.dtype(get_args(get_args(kind)[1])[0]).newbyteorder("<")
    numbers = np.frombuffer(array.data, dtype=dtype) if array.data else np.empty(0, dtype=dtype)
    if math.prod(array.shape) != len(numbers):
        raise InputError(f"{len(numbers)} numbers are not of the shape {array.shape}")
    return numbers.reshape(array.shape).astype(dtype.newbyteorder("="))


def _check_known(document: Any, made: Any) -> None:
    """Refuse fields of a document that what was made of it does not have."""
    if isinstance(made, tuple):
        for entry, part in zip(document, made, strict=True):
            _check_known(entry, part)
    elif is_dataclass(made):
        unknown = document.keys() - {each.name for each in fields(made)}
        if unknown:
            raise InputError(f"unknown field {min(unknown)!r}")
        for name, entry in document.items():
            _check_known(entry, getattr(made, name))
