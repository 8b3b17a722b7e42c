"""Read pickles of NumPy arrays in lists and tuples without running their code.

A pickle is a program for a stack machine that can import and call anything. Its opcodes are
checked before Python's unpickler runs them. Imports are replaced by stand-ins, which record the
arguments of their calls; the arrays are built from these records. Memory and time are bounded by
the file's size.
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
from cadalign.io.documents import name_file
from cadalign.io.files import as_path, damage_error, read_bytes

# Numbers, text and objects; no structured types, whose fields can hide objects.
_PLAIN_DTYPE = re.compile(r"b1|[iufc]\d{1,2}|[SU][1-9]\d{0,5}|O\d?")
_MAX_DEPTH = 100
_VALUES_PER_BYTE = 10  # maximum number of values per byte of the file
_FIX = "use a pickle of NumPy arrays, lists and tuples only: other pickles can run code"
# No dictionaries and sets: hashing a key may take forever.
_STEPS = re.compile(
    r"PROTO|FRAME|STOP|MARK|MEMOIZE|(LONG_)?(BIN)?(PUT|GET)|(STACK_)?GLOBAL|REDUCE|BUILD"
    r"|NONE|NEW(TRUE|FALSE)|(BIN)?INT[12]?|LONG[14]?|(BIN)?FLOAT"
    r"|(SHORT_)?(BIN)?(STRING|UNICODE|BYTES)8?|BYTEARRAY8"
    r"|(EMPTY_)?(LIST|TUPLE)|TUPLE[123]|APPENDS?"
)


def load_pickle(path: str | os.PathLike[str]) -> Any:
    """Load a pickle of NumPy arrays, numbers, texts, and lists and tuples of these.

    Pickles of NumPy 1 and 2 are supported, and of Python 2 except protocol 0. Text of Python 2 is
    decoded as Latin-1, which keeps its bytes. An array of objects becomes a list.

    Raises DataError if the file cannot be read, is incomplete, or holds or imports anything else.
    """
    data = read_bytes(as_path(path))
    try:
        with name_file(str(path)):
            for step, argument, _ in pickletools.genops(data):
                if not _STEPS.fullmatch(step.name):
                    raise ValueError(f"the opcode {step.name} is not allowed")
                if "PUT" in step.name and int(argument or 0) > len(data):
                    raise ValueError(f"the memo index {argument} is too large")
            value = _Unpickler(io.BytesIO(data), encoding="latin-1").load()
            return _Builder(_VALUES_PER_BYTE * len(data)).build(value)
    except DataError:
        raise
    except Exception as error:  # any opcode of a damaged pickle may fail
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise damage_error(f"not a whole pickle of arrays ({reason})", path) from None


class _Dtype:
    """Stand-in for a NumPy dtype."""

    def __init__(self, code: str, *_flags: Any) -> None:
        if not _PLAIN_DTYPE.fullmatch(code):
            raise ValueError(f"the dtype {quote(code)} is not allowed")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])  # the code implies the rest


@dataclass(eq=False)
class _Array:
    """Stand-in for an array or a scalar; its data are bytes, their Latin-1 text, or objects."""

    dtype: Any
    data: Any
    shape: Any = None  # None for a scalar
    order: Any = "C"
    axes: Any = None  # order of a transpose

    def __setstate__(self, state: Any) -> None:
        _, self.shape, self.dtype, is_fortran, self.data = state
        self.order, self.axes = "F" if is_fortran else "C", None


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> _Array:
    return _Array(dtype, data, shape, "F" if order == "F" else "C", axes if order == "K" else None)


def _bytes(text: str = "", encoding: str = "latin1") -> str:
    """Stand-in for the encoding of text to bytes; the text is kept."""
    if encoding != "latin1":
        raise ValueError(f"{quote(encoding)} is not Latin-1")
    return text


_STAND_INS = {
    "numpy._core.multiarray._reconstruct": _Array,  # filled by __setstate__
    "numpy._core.multiarray.scalar": _Array,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy.dtype": _Dtype,
    "numpy.ndarray": _Array,
    "builtins.bytes": _bytes,
    "_codecs.encode": _bytes,
}


class _Unpickler(pickle.Unpickler):
    """Python's unpickler, restricted to importing stand-ins."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the stand-in for an import; raises DataError if there is none."""
        # Python 2 and NumPy 1 use other names for these modules.
        current = module.replace("__builtin__", "builtins").replace("numpy.core.", "numpy._core.")
        if f"{current}.{name}" not in _STAND_INS:
            asked = quote(f"{module}.{name}")[1:-1]
            raise DataError(f"the pickle imports {asked}, which is not allowed", fix=_FIX)
        return _STAND_INS[f"{current}.{name}"]


class _Builder:
    """Replace stand-ins by arrays.

    A list that occurs several times counts each time, because it is traversed each time.
    """

    def __init__(self, most: int) -> None:
        self._left = most
        self._bytes: dict[str, bytes] = {}  # by text, which several arrays may share

    def build(self, value: Any, depth: int = 0) -> Any:
        self._left -= 1
        if self._left < 0 or depth > _MAX_DEPTH:
            raise ValueError("its values are nested too deeply, or too many for the file's size")
        if isinstance(value, _Array):
            if not value.dtype.dtype.hasobject:
                return self._array(value)
            if type(value.data) is not list or value.shape != (len(value.data),):
                raise ValueError(f"the objects do not fit an array of shape {quote(value.shape)}")
            value = value.data
        if isinstance(value, list | tuple):
            return type(value)([self.build(each, depth + 1) for each in value])
        if value is None or isinstance(value, int | float | str | bytes | bytearray):
            return value
        raise TypeError(f"a value of type {quote(type(value).__name__)} is not allowed")

    def _array(self, stand_in: _Array) -> Any:
        """Build an array as a view of its bytes, which several arrays may share."""
        content, dtype = stand_in.data, stand_in.dtype.dtype
        if isinstance(content, str):
            if content not in self._bytes:
                self._bytes[content] = content.encode("latin-1")
            content = self._bytes[content]
        shape = () if stand_in.shape is None else stand_in.shape
        if math.prod(shape) * dtype.itemsize != len(content):
            raise ValueError(f"the data do not fit an array of shape {quote(shape)}")
        array = np.ndarray(shape, dtype, content, order=stand_in.order)
        if stand_in.axes is not None:
            array = array.transpose(stand_in.axes)
        return array[()] if stand_in.shape is None else array
