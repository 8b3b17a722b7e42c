"""Pickles of NumPy arrays and plain containers, read without running code.

A pickle is a program for a stack machine, which may import and call anything. The machine here
builds values alone: what a program may name is a word that it knows, the arrays are made from their
shapes, types and bytes, and whatever else is asked for is refused. Memory and time are bounded by
the file's size.
"""

from __future__ import annotations

import codecs
import io
import math
import os
import pickletools
import re
from collections.abc import Iterator, ValuesView
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cadalign.errors import DataError, quote
from cadalign.io.documents import in_file
from cadalign.io.files import as_path, damaged, read_bytes

# Numbers and text; no records, whose fields can hide objects.
_PLAIN_DTYPE = re.compile(r"b1|[iufc]\d{1,2}|[SU][1-9]\d{0,5}|O\d?")
_MAX_DEPTH = 100
_MOST_TIMES = 10  # as many values as the file has bytes
_PARTS = (list, tuple, ValuesView)
_FIX = (
    "only NumPy arrays and plain containers are loaded, a pickle can run code; get a trusted file"
)
_ARRAY, _DTYPE, _NDARRAY = "numpy._core.multiarray._reconstruct", "numpy.dtype", "numpy.ndarray"
_SCALAR, _BUFFER = "numpy._core.multiarray.scalar", "numpy._core.numeric._frombuffer"
_BYTES, _ENCODE = "builtins.bytes", "_codecs.encode"
_KNOWN = {_ARRAY, _DTYPE, _NDARRAY, _SCALAR, _BUFFER, _BYTES, _ENCODE}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
# Steps of containers, and how many values each takes; None for those from the last mark on.
_COUNTS: dict[str, int | None] = {
    **dict.fromkeys(("EMPTY_LIST", "EMPTY_TUPLE", "EMPTY_DICT"), 0),
    "TUPLE1": 1,
    "TUPLE2": 2,
    "TUPLE3": 3,
    "APPEND": 1,
    "SETITEM": 2,
    **dict.fromkeys(("LIST", "TUPLE", "DICT", "APPENDS", "SETITEMS")),
}
_STEPS = {step.code.encode("latin-1"): step for step in pickletools.opcodes}
_LITERALS = {
    step.name
    for step in pickletools.opcodes
    if step.arg and not step.stack_before and step.stack_after
    and step.stack_after[0] is not pickletools.anyobject
}  # fmt: skip
"""Steps that push their argument, a number or a text."""


@dataclass
class _Named:
    """A name that a pickle calls; an array or a type of arrays is made first, then filled."""

    name: str
    value: Any = None


def load_pickle(path: str | os.PathLike[str]) -> Any:
    """Load a pickle of NumPy arrays, numbers, texts, and lists, tuples and dictionaries of these.

    Pickles of Python 2 and of old and new NumPy are understood. Text of Python 2 is taken as
    Latin-1, the encoding that keeps its bytes. An array of objects becomes a list.

    Raises DataError if the file cannot be read, is no whole pickle, or asks for anything else.
    """
    data = read_bytes(as_path(path))
    try:
        with in_file(str(path)):
            value = _run(data)
        _check_size(value, most=_MOST_TIMES * len(data))
        return value
    except DataError:
        raise
    except Exception as error:  # any step of a damaged pickle may fail
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise damaged(f"not a whole pickle of arrays ({reason})", path) from None


def _run(data: bytes) -> Any:
    """Build the value that a pickle's program describes."""
    stack: list[Any] = []
    marks: list[int] = []
    memory: dict[int, Any] = {}
    copied = 0

    def popped(count: int | None = None) -> list[Any]:
        """Take the last values, by default those from the last mark on."""
        start = marks.pop() if count is None else len(stack) - count
        values = [_value_of(each) for each in stack[start:]]
        del stack[start:]
        return values

    for name, argument in _steps(data):
        if name in _LITERALS:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name == "MARK":
            marks.append(len(stack))
        elif name in _COUNTS:
            values = popped(_COUNTS[name])
            if "TUPLE" in name:
                stack.append(tuple(values))
            elif "LIST" in name:
                stack.append(values)
            elif "APPEND" in name:
                _of(list, stack[-1]).extend(values)
            else:
                if "DICT" in name:
                    stack.append({})
                keys = [_of(str | bytes | int | float, key) for key in values[::2]]
                _of(dict, stack[-1]).update(zip(keys, values[1::2], strict=True))
        elif name in ("MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT"):
            memory[len(memory) if name == "MEMOIZE" else int(argument)] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memory[int(argument)])
        elif name in ("GLOBAL", "STACK_GLOBAL"):
            stack.append(_named(*(argument.split(" ") if argument else popped(2))))
        elif name in ("REDUCE", "BUILD"):
            (arguments,) = popped(1)
            copied += sum(len(each) for each in _of(tuple, arguments) if isinstance(each, str))
            if copied > _MOST_TIMES * len(data):
                raise ValueError("it copies a text again and again")
            called = _of(_Named, stack[-1])
            if name == "BUILD":
                _fill(called, *arguments)
            else:
                stack[-1] = _made(called.name, *arguments)
        elif name not in ("PROTO", "FRAME"):
            raise ValueError(f"{name} is no step of arrays and plain containers")
    (value,) = popped(len(stack))
    return value


def _steps(data: bytes) -> Iterator[tuple[str, Any]]:
    """A program's steps to its end, each with its argument."""
    stream = io.BytesIO(data)
    while (code := stream.read(1)) != b".":
        step = _STEPS[code]
        if step.name == "STRING":  # Python 2's, which need not be ASCII
            text = pickletools.read_stringnl(stream, decode=False)
            yield step.name, codecs.escape_decode(text)[0].decode("latin-1")
        else:
            yield step.name, step.arg.reader(stream) if step.arg else None


def _of(kind: Any, value: Any) -> Any:
    """The value, which must be of a kind."""
    if not isinstance(value, kind):
        raise TypeError(f"{quote(value)} stands in the place of another kind of value")
    return value


def _value_of(item: Any) -> Any:
    """The value of an item of the stack: what was made by a name, where that is whole."""
    return item.value if isinstance(item, _Named) and item.value is not None else item


def _named(module: str, attribute: str) -> _Named:
    # Python 2 and NumPy 1 call the same modules otherwise.
    current = module.replace("__builtin__", "builtins").replace("numpy.core.", "numpy._core.")
    if f"{current}.{attribute}" not in _KNOWN:
        asked = quote(f"{module}.{attribute}")[1:-1]
        raise DataError(f"the pickle asks for {asked}, which is refused", fix=_FIX)
    return _Named(f"{current}.{attribute}")


def _made(name: str, *arguments: Any) -> Any:
    """Make what a name is called for: an array or its type is filled later."""
    if name == _DTYPE:
        code = arguments[0]
        if not _PLAIN_DTYPE.fullmatch(code):
            raise ValueError(f"the dtype {quote(code)} is not one of plain values")
        return _Named(name, np.dtype(code))
    if name == _ARRAY and arguments[0] == _Named(_NDARRAY):
        return _Named(name)
    if name == _SCALAR:
        return _array((), *arguments)[()]
    if name == _BUFFER:
        buffer, dtype, shape, order, *axes = arguments
        array = _array(shape, dtype, buffer, order="F" if order == "F" else "C")
        return array.transpose(axes[0]) if order == "K" and axes else array
    if name == _BYTES and not arguments:
        return b""
    if name == _ENCODE and arguments[1] == "latin1":  # bytes, as Python 3 writes them for Python 2
        return arguments[0].encode("latin1")
    raise ValueError(f"{name} of {quote(arguments)} is no plain value")


def _fill(made: _Named, *state: Any) -> None:
    if made.name == _DTYPE:  # (version, byte order, ...); the rest follows from the code
        made.value = made.value.newbyteorder(state[1])
        return
    if made.name != _ARRAY:
        raise ValueError(f"{made.name} cannot be changed")
    _, shape, dtype, is_fortran, data = state
    if dtype.hasobject:
        made.value = _of(list, data)
        if shape != (len(data),):
            raise ValueError(f"an array of shape {quote(shape)} has {len(data)} objects")
    else:
        made.value = _array(shape, dtype, data, order="F" if is_fortran else "C")


def _array(
    shape: Any, dtype: np.dtype[Any], data: bytes | str, *, order: Literal["C", "F"] = "C"
) -> npt.NDArray[Any]:
    """An array that looks at its bytes: one and the same may belong to many."""
    content = data.encode("latin1") if isinstance(data, str) else data
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError(f"an array of shape {quote(shape)} has other data than that")
    return np.ndarray(shape, dtype, content, order=order)


def _check_size(value: Any, *, most: int) -> None:
    """Refuse deep nesting, containers in themselves, and more values than a file can have.

    Shared containers count as often as they are found: who walks through them finds all.
    """
    level, count = [value], 0
    for _ in range(_MAX_DEPTH):
        count += len(level)
        if not level or count > most:
            break
        parts = [each.values() if isinstance(each, dict) else each for each in level]
        level = [each for part in parts if isinstance(part, _PARTS) for each in part]
    if level:
        raise ValueError("its values are nested too deeply, or more than the file has bytes")
