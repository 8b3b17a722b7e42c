"""Pickles of NumPy arrays and plain containers, loaded without running code.

A pickle is a program: it may import and call anything. Here it gets nothing but what rebuilds
arrays, NumPy scalars, sets and ordered dictionaries; asking for anything else is refused before it
is imported. NumPy's own ``dtype`` and ``ndarray`` are not handed out either: their ``__setstate__``
trusts flags and lengths in the pickle, and can be made to read bytes as addresses of objects.

Memory and time are bounded by the file's size: the program is read once without being run, which
finds places in its memory beyond its length and nesting deep enough to exhaust the stack, and
what it built must not hold more values than the file has bytes.
"""

from __future__ import annotations

import collections
import io
import math
import os
import pickle
import pickletools
import re
from collections.abc import Collection
from typing import Any

import numpy as np

from cadalign.errors import DataError, quote
from cadalign.io.files import as_path, damaged, read_bytes

# Numbers, text and objects; no records, whose fields can hide objects.
_PLAIN_DTYPE = re.compile(r"b1|[iufc]\d{1,2}|[SU]\d{1,6}|O\d?")
_MAX_DEPTH = 100
_FILLING = frozenset(("APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"))
_FIX = (
    "only NumPy arrays and plain containers are loaded, a pickle can run code; get a trusted file"
)


def load_pickle(path: str | os.PathLike[str]) -> Any:
    """Load a pickle of NumPy arrays (as a subclass), numbers, text, and containers of these.

    Pickles of Python 2 and of old and new NumPy are understood. Text of Python 2 is taken as
    Latin-1, the encoding that keeps its bytes.
    """
    data = read_bytes(as_path(path))
    try:
        _check_program(data)
        value = _PlainUnpickler(io.BytesIO(data), str(path)).load()
        _check_size(value, limit=10 * len(data))
        return value
    except DataError:
        raise
    except Exception as error:  # damaged pickles make the unpickler raise what it likes
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise damaged(f"not a whole pickle of arrays ({reason})", path) from None


def _check_program(data: bytes) -> None:
    """Follow the pickle's stack with the nesting depths of its values in the place of values.

    Refused are values that are nested too deeply (hashing them would exhaust the stack), and places
    in the pickle's memory numbered beyond its length (the unpickler would allocate them all).
    """
    stack: list[int] = []
    marks: list[int] = []
    memory: dict[int, int] = {}
    argument: Any
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        name = opcode.name
        if name == "MARK":
            marks.append(len(stack))
        elif name == "MEMOIZE":
            memory[len(memory)] = stack[-1]
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            if int(argument) > count:
                raise pickle.UnpicklingError("a place in memory beyond the pickle's length")
            memory[int(argument)] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memory[int(argument)])
        else:
            if pickletools.markobject in opcode.stack_before:
                start = marks.pop()
                # What stands before the mark: the container that is filled.
                start -= opcode.stack_before.index(pickletools.markobject)
            else:
                start = len(stack) - len(opcode.stack_before)
            used = stack[start:]
            del stack[start:]
            if name in _FILLING and used:
                depth = max(used[0], 1 + max(used[1:], default=0))
            else:
                depth = 1 + max(used, default=0)
            if depth > _MAX_DEPTH:
                raise pickle.UnpicklingError(f"values are nested more than {_MAX_DEPTH} deep")
            stack.extend([depth] * len(opcode.stack_after))


def _check_size(value: Any, *, limit: int) -> None:
    """Refuse a container in itself, and shared ones that written out exceed the limit."""
    sizes: dict[int, int] = {}
    unfinished: set[int] = set()
    waiting: list[tuple[Any, bool]] = [(value, False)]
    while waiting:
        item, is_done = waiting.pop()
        items = _items(item)
        if is_done:
            unfinished.remove(id(item))
            sizes[id(item)] = 1 + sum(sizes.get(id(each), 1) for each in items)
            if sizes[id(item)] > limit:
                raise pickle.UnpicklingError("it holds more values than the file has bytes")
        elif id(item) in unfinished:
            raise pickle.UnpicklingError("a container holds itself")
        elif id(item) not in sizes and items:
            unfinished.add(id(item))
            waiting.append((item, True))
            waiting.extend((each, False) for each in items)


def _items(value: Any) -> Collection[Any]:
    if isinstance(value, dict):
        return value.values()
    if isinstance(value, list | tuple | set | frozenset):
        return value
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        return list(value.flat)
    return ()


class _PlainUnpickler(pickle.Unpickler):
    def __init__(self, file: Any, where: str) -> None:
        super().__init__(file, encoding="latin1")
        self._where = where
        self._allowed = _make_allowed()

    def find_class(self, module: str, name: str) -> Any:
        # Python 2 and NumPy 1 call the same modules otherwise.
        current = module.replace("__builtin__", "builtins").replace("numpy.core.", "numpy._core.")
        if (current, name) not in self._allowed:
            what = f"the pickle asks for {quote(f'{module}.{name}')[1:-1]}, which is refused"
            raise DataError(what, where=self._where, fix=_FIX)
        return self._allowed[current, name]


class _Dtype:
    """Stands for ``numpy.dtype`` while a pickle is read."""

    def __init__(self, code: str, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or not _PLAIN_DTYPE.fullmatch(code):
            raise pickle.UnpicklingError(f"the dtype {quote(code)} is not one of plain values")
        self.value: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # (version, byte order, subdtype, names, fields, ...); the rest follows from the code.
        self.value = self.value.newbyteorder(state[1])


class _Array(np.ndarray[Any, Any]):
    """An array that checks what it is rebuilt from."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran_order, data = state
        count = math.prod(_as_shape(shape))
        values: np.dtype[Any] = dtype.value
        if values.hasobject:
            fits = isinstance(data, list) and len(data) == count
        else:
            fits = isinstance(data, bytes | str) and len(data) == count * values.itemsize
        # Refilling an array would pull its memory away from whatever looks at it already.
        if not fits or self.size:
            what = f"an array of shape {quote(shape)} has other data than that"
            raise pickle.UnpicklingError(what)
        # NumPy's stubs ask for a numpy.bool, which it doesn't take.
        rebuilt: Any = (1, shape, values, bool(fortran_order), data)
        super().__setstate__(rebuilt)

    def __reduce_ex__(self, protocol: Any) -> Any:
        # Pickled again, for a worker process, it is an array like any other.
        return self.view(np.ndarray).__reduce_ex__(protocol)


def _make_allowed() -> dict[tuple[str, str], Any]:
    """All that a pickle may name.

    Made anew for each file: a pickle can set attributes of the functions that it is given.
    """
    array_type = object()  # for ``numpy.ndarray``, which pickles name but need not call

    def reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
        if kind is not array_type:
            raise pickle.UnpicklingError("only plain arrays can be loaded")
        return np.empty(0).view(_Array)

    def scalar(dtype: _Dtype, data: bytes | str) -> Any:
        content = data.encode("latin1") if isinstance(data, str) else bytes(data)
        return np.frombuffer(content, dtype=dtype.value, count=1)[0]

    def from_buffer(
        buffer: bytes | bytearray, dtype: _Dtype, shape: Any, order: str, axes: Any = None
    ) -> Any:
        flat = np.frombuffer(bytes(buffer), dtype=dtype.value)
        if order == "K" and axes is not None:
            return flat.reshape(_as_shape(shape)).transpose(axes)
        return flat.reshape(_as_shape(shape), order="F" if order == "F" else "C")

    def encode(text: str, encoding: str) -> bytes:
        # How Python 3 writes bytes so that Python 2 can read them.
        if encoding != "latin1":
            raise pickle.UnpicklingError(f"the encoding {quote(encoding)} is not expected")
        return text.encode("latin1")

    return {
        ("numpy", "ndarray"): array_type,
        ("numpy", "dtype"): _Dtype,
        ("numpy._core.multiarray", "_reconstruct"): reconstruct,
        ("numpy._core.multiarray", "scalar"): scalar,
        ("numpy._core.numeric", "_frombuffer"): from_buffer,
        ("_codecs", "encode"): encode,
        ("builtins", "bytes"): lambda: b"",
        ("builtins", "set"): set,
        ("builtins", "frozenset"): frozenset,
        ("collections", "OrderedDict"): collections.OrderedDict,
    }


def _as_shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise pickle.UnpicklingError(f"{quote(shape)} is not a shape")
    return shape
