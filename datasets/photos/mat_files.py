"""MATLAB's .mat files as plain values, read by SciPy."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.errors import DataError, brief
from cadalign.io.files import read_bytes

_HEADER = 128
_COMPRESSED = 15
# Of the largest variable when it is uncompressed, and beyond that for each byte of the file.
_FREE_BYTES, _EXPANSION = 2**26, 32
_FIX = "get the file again; save one of MATLAB's version 7.3 with the option -v7"


def read_structs(path: Path, name: str) -> list[dict[str, Any]]:
    """Read the struct, or the array of structs, that a .mat file holds under a name.

    Structs are dictionaries, arrays of them and of texts are lists; what is empty is None.

    Raises DataError if the file cannot be read, is none of MATLAB's up to version 7, or holds no
    such structs.
    """
    from scipy.io import loadmat, matlab  # takes a while to import

    data = read_bytes(path)
    try:
        if matlab.matfile_version(io.BytesIO(data))[0] == 1:
            data = _uncompressed(data)
        found = loadmat(io.BytesIO(data), variable_names=[name], simplify_cells=True)
    except Exception as error:  # damaged files make SciPy raise what it likes
        what = f"not a MATLAB file that can be read ({brief(error)})"
        raise DataError(what, where=str(path), fix=_FIX) from None
    structs = structs_of(_plain(found.get(name)))
    if not structs:
        raise DataError(f"there are no structs named {name} in this file", where=str(path))
    return structs


def structs_of(value: Any) -> list[dict[str, Any]]:
    """The structs of a field: one is no list."""
    values = value if isinstance(value, list) else [value]
    return [each for each in values if isinstance(each, dict)]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [_plain(each) for each in value] or None
    return None if np.size(value) == 0 else value


def _uncompressed(data: bytes) -> bytes:
    """A file of version 5 to 7 whose variables are uncompressed, and their checksums compared.

    SciPy compares them after it has read a variable, and what is damaged can crash it before.
    """
    tag = "<II" if data[_HEADER - 2 : _HEADER] == b"IM" else ">II"
    most = _FREE_BYTES + _EXPANSION * len(data)
    parts, start = [data[:_HEADER]], _HEADER
    while start < len(data):
        kind, size = struct.unpack_from(tag, data, start)
        content = start + struct.calcsize(tag)
        end = content + size
        if end > len(data):
            raise ValueError("it is cut short")
        if kind == _COMPRESSED:
            stream = zlib.decompressobj()
            parts.append(stream.decompress(data[content:end], most))
            if not stream.eof:
                raise ValueError(f"a variable is cut short, or has more than {most} bytes")
        else:
            parts.append(data[start:end])
        start = end
    return b"".join(parts)
