"""Pickles of NumPy arrays in lists and tuples, read without running code.

A pickle is a program for a stack machine, which may import and call anything. So its steps are
looked through before Python's own reader takes them, and what it imports are stand-ins: they keep
what they are called with, and the arrays are made from that in the end. Memory and time are bounded
by the file's size.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import pickletools
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadalign.errors import DataError, quote
from cadalign.io.documents import in_file
from cadalign.io.files import as_path, damaged, read_bytes

# Numbers and text; no records, whose fields can hide objects.
_PLAIN_DTYPE = re.compile(r"b1|[iufc]\d{1,2}|[SU][1-9]\d{0,5}|O\d?")
_MAX_DEPTH = 100
_MOST_TIMES = 10  # as many values as the file has bytes
_FIX = "only NumPy arrays, lists and tuples are loaded, a pickle can run code; get a trusted file"
# No dictionaries and sets: a key's hash may take forever.
_STEPS = re.compile(
    r"PROTO|FRAME|STOP|MARK|MEMOIZE|(LONG_)?(BIN)?(PUT|GET)|(STACK_)?GLOBAL|REDUCE|BUILD"
    r"|NONE|NEW(TRUE|FALSE)|(BIN)?INT[12]?|LONG[14]?|(BIN)?FLOAT"
    r"|(SHORT_)?(BIN)?(STRING|UNICODE|BYTES)8?|BYTEARRAY8"
    r"|(EMPTY_)?(LIST|TUPLE)|TUPLE[123]|APPENDS?"
)


def load_pickle(path: str | os.PathLike[str]) -> Any:
    """Load a pickle of NumPy arrays, numbers, texts, and lists and tuples of these.

    Pickles of old and new NumPy are understood, and those of Python 2 but for protocol 0. Text of
    Python 2 is taken as Latin-1, the encoding that keeps its bytes. An array of objects becomes a
    list.

    Raises DataError if the file cannot be read, is no whole pickle, or asks for anything else.
    """
    data = read_bytes(as_path(path))
    try:
        with in_file(str(path)):
            for step, argument, _ in pickletools.genops(data):
                if not _STEPS.fullmatch(step.name):
                    raise ValueError(f"{step.name} is no step of arrays, lists and tuples")
                if "PUT" in step.name and int(argument or 0) > len(data):
                    raise ValueError(f"it remembers no {argument} values")
            value = _Reader(io.BytesIO(data), encoding="latin-1").load()
            return _Builder(_MOST_TIMES * len(data)).built(value)
    except DataError:
        raise
    except Exception as error:  # any step of a damaged pickle may fail
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise damaged(f"not a whole pickle of arrays ({reason})", path) from None


class _Dtype:
    """Stands for a type of arrays."""

    def __init__(self, code: str, *_flags: Any) -> None:
        if not _PLAIN_DTYPE.fullmatch(code):
            raise ValueError(f"the dtype {quote(code)} is not one of plain values")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])  # the rest follows from the code


@dataclass(eq=False)
class _Array:
    """Stands for an array or a scalar; its data are bytes, their Latin-1 text, or objects."""

    dtype: Any
    data: Any
    shape: Any = None  # of a scalar
    order: Any = "C"
    axes: Any = None  # that transpose it

    def __setstate__(self, state: Any) -> None:
        _, self.shape, self.dtype, is_fortran, self.data = state
        self.order, self.axes = "F" if is_fortran else "C", None


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> _Array:
    return _Array(dtype, data, shape, "F" if order == "F" else "C", axes if order == "K" else None)


def _bytes(text: str = "", encoding: str = "latin1") -> str:
    """Bytes as Python 3 writes them for Python 2, which stay the text that they are written as."""
    if encoding != "latin1":
        raise ValueError(f"{quote(encoding)} is not Latin-1")
    return text


_STAND_INS = {
    "numpy._core.multiarray._reconstruct": _Array,  # of nothing that counts, filled afterwards
    "numpy._core.multiarray.scalar": _Array,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy.dtype": _Dtype,
    "numpy.ndarray": _Array,
    "builtins.bytes": _bytes,
    "_codecs.encode": _bytes,
}


class _Reader(pickle.Unpickler):
    """Python's reader, which imports nothing but stand-ins."""

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in for what a pickle imports; raises DataError where there is none."""
        # Python 2 and NumPy 1 call the same modules otherwise.
        current = module.replace("__builtin__", "builtins").replace("numpy.core.", "numpy._core.")
        if f"{current}.{name}" not in _STAND_INS:
            asked = quote(f"{module}.{name}")[1:-1]
            raise DataError(f"the pickle asks for {asked}, which is refused", fix=_FIX)
        return _STAND_INS[f"{current}.{name}"]


class _Builder:
    """Makes the arrays in the places of their stand-ins.

    Shared lists count as often as they are found: who walks through them finds all.
    """

    def __init__(self, most: int) -> None:
        self._left = most
        self._bytes: dict[str, bytes] = {}  # by their text, which may belong to many arrays

    def built(self, value: Any, depth: int = 0) -> Any:
        self._left -= 1
        if self._left < 0 or depth > _MAX_DEPTH:
            raise ValueError("its values are nested too deeply, or more than the file has bytes")
        if isinstance(value, _Array):
            if not value.dtype.dtype.hasobject:
                return self._array(value)
            if type(value.data) is not list or value.shape != (len(value.data),):
                raise ValueError(f"an array of shape {quote(value.shape)} has other objects")
            value = value.data
        if isinstance(value, list | tuple):
            return type(value)([self.built(each, depth + 1) for each in value])
        if value is None or isinstance(value, int | float | str | bytes | bytearray):
            return value
        raise TypeError(f"{quote(type(value).__name__)} is no plain value")

    def _array(self, made: _Array) -> Any:
        """An array that looks at its bytes: one and the same may belong to many."""
        content, dtype = made.data, made.dtype.dtype
        if isinstance(content, str):
            if content not in self._bytes:
                self._bytes[content] = content.encode("latin-1")
            content = self._bytes[content]
        shape = () if made.shape is None else made.shape
        if math.prod(shape) * dtype.itemsize != len(content):
            raise ValueError(f"an array of shape {quote(shape)} has other data than that")
        array = np.ndarray(shape, dtype, content, order=made.order)
        if made.axes is not None:
            array = array.transpose(made.axes)
        return array[()] if made.shape is None else array
