"""MATLAB's .mat files as plain values, read by SciPy."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, InputError, brief, quote
from cadalign.io.files import read_bytes

_HEADER = 128
_COMPRESSED = 15
# Of the largest variable when it is uncompressed, and beyond that for each byte of the file.
_FREE_BYTES, _EXPANSION = 2**26, 32
_FIX = "get the file again; save one of MATLAB's version 7.3 with the option -v7"


@dataclass(frozen=True)
class MatStruct:
    """A struct of a .mat file; its fields are read by name."""

    _value: Mapping[str, Any]
    where: str  # the file and the place in it, for messages

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its fields."""
        return tuple(self._value)

    def struct(self, name: str) -> MatStruct | None:
        """A field that is one struct; None where it is missing or empty."""
        found = self.structs(name)
        return found[0] if len(found) == 1 else None

    def structs(self, name: str) -> tuple[MatStruct, ...]:
        """A field that is an array of structs, or a single one."""
        return _structs(self._value.get(name), f"{self.where}: {name}")

    def number(self, name: str, default: float | None = None) -> float:
        """A field that is a finite number.

        Raises InputError if it is not, or it is missing and there is no default.
        """
        array = self._values(name)
        if array.size == 0 or self._value.get(name) is None:
            if default is None:
                raise InputError("missing", where=name)
            return default
        if array.size != 1 or array.dtype.kind not in "biuf" or not np.isfinite(array).all():
            what = f"{quote(self._value[name])} is not a finite number"
            raise InputError(what, where=name)
        return float(array.reshape(()))

    def text(self, name: str) -> str:
        """A field that is a text; raises InputError if it is not."""
        value = self._value.get(name)
        if not isinstance(value, str) or not value.strip() or "\0" in value:
            raise InputError(f"{quote(value)} is not a text", where=name)
        return value

    def texts(self, name: str) -> tuple[str, ...]:
        """The texts of a field that is a list of them, or a single one."""
        return tuple(str(each) for each in self._values(name).ravel() if isinstance(each, str))

    def array(self, name: str, columns: int | None = None) -> FloatArray:
        """A field of finite numbers; as rows of so many columns where this is given.

        Raises InputError if it is missing, holds other things, or cannot have so many columns.
        """
        value = self._values(name)
        if value.dtype.kind not in "biuf":
            raise InputError("not an array of numbers", where=name)
        array = value.astype(np.float64)
        if not np.isfinite(array).all():
            raise InputError("some of its numbers are not finite", where=name)
        if columns is None:
            return array
        if array.size % columns or (array.ndim > 1 and array.shape[-1] != columns):
            raise InputError(f"shape {array.shape} has not {columns} columns", where=name)
        return array.reshape(-1, columns)

    def _values(self, name: str) -> npt.NDArray[Any]:
        """A field as an array; of one object where it is missing or holds structs."""
        value = self._value.get(name)
        return np.asarray(None if isinstance(value, list) else value)


def read_structs(path: Path, name: str) -> tuple[MatStruct, ...]:
    """Read the array of structs that a .mat file holds under a name.

    Raises DataError if the file cannot be read, is none of MATLAB's up to version 7, or holds no
    such structs.
    """
    from scipy.io import loadmat, matlab  # takes a while to import

    data = read_bytes(path)
    try:
        if matlab.matfile_version(io.BytesIO(data))[0] == 1:
            data = _uncompressed(data)
        # Structs become dictionaries, arrays of them lists.
        found = loadmat(io.BytesIO(data), variable_names=[name], simplify_cells=True)
    except Exception as error:  # damaged files make SciPy raise what it likes
        what = f"not a MATLAB file that can be read ({brief(error)})"
        raise DataError(what, where=str(path), fix=_FIX) from None
    structs = _structs(found.get(name), str(path))
    if not structs:
        raise DataError(f"there are no structs named {name} in this file", where=str(path))
    return structs


def _structs(value: Any, where: str) -> tuple[MatStruct, ...]:
    values = value if isinstance(value, list) else [value]
    return tuple(
        MatStruct(each, f"{where}[{number}]")
        for number, each in enumerate(values)
        if isinstance(each, dict)
    )


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
