"""MATLAB's .mat files as plain values: nothing in them is run."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, InputError, quote
from cadalign.io.files import damaged, read_bytes

_HEADER = 128
_LEVEL = 0x0100
_TAG = 8  # bytes of an element's tag, to multiples of which elements are padded
_DEEPEST = 50
# Of the largest variable when it is uncompressed, and beyond that for each byte of the file.
_FREE_BYTES, _EXPANSION = 2**26, 32

_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _STRUCT, _OBJECT, _TEXT, _OPAQUE = 1, 2, 3, 4, 17
_ARRAYS = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
_COMPLEX = 0x0800
_NOTHING = np.empty(0)


def read_variables(data: bytes, names: Collection[str] | None = None) -> dict[str, Any]:
    """Read the variables of a file, or those of some names.

    Arrays have no axes of length 1, and those without any other are numbers. Structs are
    dictionaries; arrays of them, and cells, are arrays of objects. Texts of several rows are lists.

    Raises InputError if it is no such file, is cut short or damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[_HEADER - 2 : _HEADER])
    if order is None:
        raise InputError("it does not begin as one of version 5 to 7 does")
    if struct.unpack_from(f"{order}H", data, _HEADER - 4)[0] != _LEVEL:
        raise InputError("it is of version 7.3; save it with the option -v7")
    found: dict[str, Any] = {}
    outer = _Elements(memoryview(data)[_HEADER:], order)
    while outer.is_more:
        kind, content = outer.next()
        inner = outer
        if kind == _COMPRESSED:
            most = _FREE_BYTES + _EXPANSION * len(data)
            inner = _Elements(memoryview(_inflated(content, most)), order)
            kind, content = inner.next()
        if kind == _MATRIX:
            name, value = _Elements(content, order).matrix(names=names)
            # Without a name are the workspaces of functions.
            if name and (names is None or name in names):
                found[name] = value
    return found


def _inflated(content: memoryview, most: int) -> bytes:
    stream = zlib.decompressobj()
    try:
        data = stream.decompress(content, most)
    except zlib.error as error:
        raise InputError(f"a variable cannot be uncompressed ({error})") from None
    if not stream.eof and stream.unconsumed_tail:
        raise InputError(f"a variable has more than {most} bytes")
    return data


class _Elements:
    """The elements in some bytes, read one after the other."""

    def __init__(self, data: memoryview, order: str) -> None:
        self._data = data
        self._order = order
        self._place = 0

    @property
    def is_more(self) -> bool:
        return self._place < len(self._data)

    def next(self) -> tuple[int, memoryview]:
        if len(self._data) - self._place < _TAG:
            raise InputError("it is cut short")
        kind, size = struct.unpack_from(f"{self._order}II", self._data, self._place)
        start = self._place + _TAG
        if kind >> 16:  # the content of small elements stands in the tag
            kind, size, start = kind & 0xFFFF, kind >> 16, start - 4
        end = start + size
        if end > len(self._data):
            raise InputError("it is cut short")
        # Compressed elements are not padded.
        rest = -end % _TAG if kind != _COMPRESSED else 0
        self._place = max(end + rest, self._place + _TAG)
        return kind, self._data[start:end]

    def _integers(self) -> tuple[int, ...]:
        """The integers of 32 bits of the next element, one at least."""
        kind, content = self.next()
        if kind not in (5, 6) or not len(content) or len(content) % 4:
            raise InputError(f"integers of the type {kind} in {len(content)} bytes")
        return struct.unpack(f"{self._order}{len(content) // 4}i", content)

    def _numbers(self) -> npt.NDArray[Any]:
        kind, content = self.next()
        if kind not in _NUMBERS:
            raise InputError(f"numbers of the unknown type {kind}")
        try:
            return np.frombuffer(content, dtype=self._order + _NUMBERS[kind])
        except ValueError:
            raise InputError("numbers that are cut short") from None

    def matrix(self, *, names: Collection[str] | None = None, depth: int = 0) -> tuple[str, Any]:
        """The name and the value of an array of any kind, whose parts these elements are.

        The value of a name that is not among ``names`` is not read.
        """
        if not self.is_more:
            return "", _NOTHING
        if depth > _DEEPEST:
            raise InputError("it is nested too deeply")
        flags = self._integers()[0]
        kind = flags & 0xFF
        if kind == _OPAQUE:
            return "", None
        shape = self._integers()
        name = str(self.next()[1], "latin-1")
        if len(shape) < 2 or min(shape) < 0:
            raise InputError(f"an array of the shape {shape[:9]}")
        if names is not None and name not in names:
            return name, None
        if kind in _ARRAYS and not flags & _COMPLEX:
            return name, self._array(_ARRAYS[kind], shape)
        if kind == _TEXT:
            return name, self._text(shape)
        if kind in (_CELL, _STRUCT, _OBJECT):
            return name, self._objects(kind, shape, depth)
        return name, None

    def _array(self, dtype: str, shape: tuple[int, ...]) -> Any:
        values = self._numbers()
        if len(values) != math.prod(shape):
            raise InputError(f"{len(values)} numbers for an array of the shape {shape[:9]}")
        with np.errstate(all="ignore"):
            values = values.astype(dtype)
        if len(values) < 2:
            return values[0] if len(values) else _NOTHING
        return values.reshape(shape, order="F").squeeze()

    def _text(self, shape: tuple[int, ...]) -> str | list[str]:
        kind, content = self.next()
        encoding = _ENCODINGS.get(kind, "latin-1")
        if encoding in ("utf-16", "utf-32"):
            encoding += "-le" if self._order == "<" else "-be"
        text = str(content, encoding, errors="replace")
        if shape[0] <= 1:
            return text
        # Column by column; padded where characters were left out.
        return [text[row :: shape[0]] for row in range(min(shape[0], len(text)))]

    def _objects(self, kind: int, shape: tuple[int, ...], depth: int) -> Any:
        if kind == _OBJECT:
            self.next()  # the name of its class
        fields = None if kind == _CELL else self._field_names()
        each = 1 if fields is None else len(fields)
        count = math.prod(shape)
        if count * each * _TAG > len(self._data) - self._place:
            raise InputError(f"an array of {count} values is cut short")
        if not count or not each:
            return _NOTHING

        def inner() -> Any:
            kind, content = self.next()
            if kind != _MATRIX:
                raise InputError(f"an array of the unknown type {kind}")
            return _Elements(content, self._order).matrix(depth=depth + 1)[1]

        values = np.empty(count, dtype=object)
        for number in range(count):
            values[number] = inner() if fields is None else {name: inner() for name in fields}
        return values.reshape(shape, order="F").squeeze()[()]

    def _field_names(self) -> list[str]:
        length = self._integers()[0]
        names = bytes(self.next()[1])
        if length <= 0 or len(names) % length:
            raise InputError("names of fields that are cut short")
        starts = range(0, len(names), length)
        return [str(names[at : at + length].partition(b"\0")[0], "latin-1") for at in starts]


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
        value = self._value.get(name)
        values = np.atleast_1d(np.asarray(value, dtype=object)).ravel()
        return tuple(
            MatStruct(each, f"{self.where}: {name}[{number}]")
            for number, each in enumerate(values)
            if isinstance(each, dict)
        )

    def number(self, name: str, default: float | None = None) -> float:
        """A field that is a finite number.

        Raises InputError if it is not, or it is missing and there is no default.
        """
        value = self._value.get(name)
        array = np.asarray(value)
        if array.size == 0 or value is None:
            if default is None:
                raise InputError("missing", where=name)
            return default
        if array.size != 1 or array.dtype.kind not in "biuf" or not np.isfinite(array).all():
            raise InputError(f"{quote(value)} is not a finite number", where=name)
        return float(array.reshape(()))

    def text(self, name: str) -> str:
        """A field that is a text; raises InputError if it is not."""
        value = self._value.get(name)
        if not isinstance(value, str) or not value.strip() or "\0" in value:
            raise InputError(f"{quote(value)} is not a text", where=name)
        return value

    def texts(self, name: str) -> tuple[str, ...]:
        """A field that is a list of texts, or a single one."""
        value = np.atleast_1d(np.asarray(self._value.get(name, ()), dtype=object)).ravel()
        return tuple(str(each) for each in value)

    def array(self, name: str, columns: int | None = None) -> FloatArray:
        """A field of finite numbers; as rows of so many columns where this is given.

        Raises InputError if it is missing, holds other things, or cannot have so many columns.
        """
        value = np.asarray(self._value.get(name))
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


def read_structs(path: Path, name: str) -> tuple[MatStruct, ...]:
    """Read the array of structs that a .mat file holds under a name.

    Raises DataError if the file cannot be read, is none of MATLAB's up to version 7, or holds no
    such structs.
    """
    data = read_bytes(path)
    try:
        value = np.asarray(read_variables(data, (name,)).get(name), dtype=object)
    except InputError as error:
        raise damaged(f"not a .mat file that can be read ({error.what})", path) from None
    found = [each for each in np.atleast_1d(value).ravel() if isinstance(each, dict)]
    if not found:
        raise DataError(f"there are no structs named {name} in this file", where=str(path))
    return tuple(MatStruct(each, f"{path}[{number}]") for number, each in enumerate(found))
