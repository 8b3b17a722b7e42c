"""Array types, argument checks and random generators of instances."""

from __future__ import annotations

import hashlib
import math
import os
from copy import deepcopy
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError, quote

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_LEAST, _MOST = 1e-100, 1e100  # squares of values in this range do not overflow
_NUMBERS = (float, int, np.integer, np.floating)


def as_floats(
    value: Any, *, name: str, shape: tuple[int | None, ...], finite: bool = True
) -> FloatArray:
    """Convert to a float array of the given shape and refuse NaN and infinity.

    Parameters
    ----------
    value : array_like
        The argument.
    name : str
        The argument's name, for the message.
    shape : tuple of int or None
        The required shape; ``None`` for any length.
    finite : bool
        Refuse NaN and infinity.

    Returns
    -------
    (*shape) float
        A C-contiguous array; the input itself if it already is one.

    Raises
    ------
    InputError
        If the value is not numeric, has another shape, or holds NaN or infinite values.
    """
    if type(value) is np.ndarray and value.dtype == np.float64 and value.flags.c_contiguous:
        array: FloatArray = value
    else:
        array = _to_floats(value, name)
    if array.ndim != len(shape) or any(
        wanted is not None and wanted != actual
        for wanted, actual in zip(shape, array.shape, strict=True)
    ):
        wanted_text = ", ".join("n" if length is None else str(length) for length in shape)
        raise InputError(f"shape {array.shape}, expected ({wanted_text})", where=name)
    if finite and not np.isfinite(array).all():
        raise InputError(describe_non_finite(array), where=name, fix="remove or repair these")
    return array


def _to_floats(value: Any, name: str) -> FloatArray:
    try:
        found = np.asarray(value)
        if found.dtype.kind in "cmM":  # complex numbers and times
            raise TypeError(f"they are {found.dtype}")
        if is_masked(value):
            raise TypeError("some are masked")
        array = np.ascontiguousarray(value, dtype=np.float64)
        if found.dtype.kind in "SU" or (
            found.dtype.kind == "O" and any(isinstance(each, str | bytes) for each in found.flat)
        ):
            raise TypeError("they are texts")
    except (TypeError, ValueError, OverflowError) as error:
        what = f"not an array of numbers ({str(error)[:200]})"
        raise InputError(what, where=name) from None
    return array.reshape(()) if np.ndim(value) == 0 else array


def is_masked(value: object) -> bool:
    """True if any element of an array is masked; does not import ``numpy.ma``."""
    return isinstance(value, np.ndarray) and bool(np.any(getattr(value, "mask", False)))


def is_real(value: Any) -> bool:
    """True for a real Python or NumPy number, finite or not."""
    return isinstance(value, _NUMBERS) and not isinstance(value, bool | np.timedelta64)


def is_number(value: Any) -> bool:
    """True for a finite real Python or NumPy number."""
    if not is_real(value):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an int too large for a float
        return False


def is_whole(value: Any) -> bool:
    """True for a Python or NumPy integer."""
    return is_number(value) and isinstance(value, int | np.integer)


def require_counts(**given: Any) -> None:
    """Raise an InputError if any keyword argument is not a whole number >= 1."""
    for name, value in given.items():
        if not is_whole(value) or value < 1:
            raise InputError(f"{value!r} is not a whole number >= 1", where=name)


def as_positive(value: Any, *, name: str) -> float:
    """Convert a positive number of any type to a float, for kernels.

    Raises
    ------
    InputError
        If the value is not a positive number, or its square is out of range.
    """
    if not is_number(value) or not value > 0:
        raise InputError(f"{quote(value)} is not positive and finite", where=name)
    number = float(value)
    if not _LEAST <= number <= _MOST:
        raise InputError(f"{number} is not between {_LEAST:g} and {_MOST:g}", where=name)
    return number


def as_points(value: Any, *, name: str, dimension: int) -> FloatArray:
    """Check an (n, dimension) array of points; see `as_floats`."""
    return as_floats(value, name=name, shape=(None, dimension))


def describe_non_finite(array: FloatArray) -> str:
    """List the rows of an array that hold NaN or infinite values."""
    bad = ~np.isfinite(array)
    if array.ndim == 0:
        return f"is {array}"
    rows = np.flatnonzero(bad.reshape(len(array), -1).any(axis=1))
    listed = ", ".join(str(row) for row in rows[:5]) + (", ..." if len(rows) > 5 else "")
    return f"NaN or infinite values in row{'s' if len(rows) > 1 else ''} {listed}"


def worker_count(workers: Any) -> int:
    """Convert an argument ``workers`` to a number of workers; -1 means all cores.

    Raises
    ------
    InputError
        If ``workers`` is not a whole number, or neither positive nor -1.
    """
    if not isinstance(workers, int | np.integer) or (workers < 1 and workers != -1):
        what = f"must be >= 1, or -1 for all cores, not {quote(workers)}"
        raise InputError(what, where="workers")
    return (os.cpu_count() or 1) if workers == -1 else int(workers)


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Copy an array to a read-only one, unless it is read-only already."""
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array


def parse_numbers(
    text: bytes, count: int, dtype: type[np.generic] = np.float64
) -> npt.NDArray[Any]:
    """Read numbers separated by white space, (count,); raises ValueError on any other text.

    At "0.1.2" older NumPy stops after 0.1 with only a warning. The number appended to the text
    shows whether all of the text was read.
    """
    try:
        values = np.fromstring(text + b" 0", sep=" ", dtype=dtype)
    except Warning as error:  # older NumPy, if warnings are errors
        raise ValueError(str(error)) from None
    if len(values) != count + 1:
        raise ValueError("not all of it is numbers")
    return values[:-1]


def as_one_or_each(value: Any, *, name: str, count: int, entries: str) -> FloatArray:
    """Convert one positive number, or (count,) of them, to an array.

    ``entries`` names what the numbers belong to, for the message. Raises InputError if the shape is
    wrong, or a value is not positive and finite.
    """
    array = _to_floats(value, name)
    if array.shape not in ((), (count,)):
        fix = f"give one, or one for each of {count} {entries}"
        raise InputError(f"{array.size} numbers", where=name, fix=fix)
    if not ((array > 0) & (array < np.inf)).all():
        raise InputError("must be positive and finite", where=name)
    return array


def copy_argument(value: Any) -> Any:
    """Copy an array-like argument, which the caller may change later."""
    try:
        return deepcopy(value)
    except TypeError:  # a memoryview
        return np.array(value)


def instance_rng(seed: int, *names: str) -> np.random.Generator:
    """Make the random generator of one instance of a dataset.

    Results then do not depend on the order of instances or the number of workers.

    Parameters
    ----------
    seed : int
        The run's seed.
    *names : str
        Names of the instance, such as category and model id.

    Examples
    --------
    >>> first = instance_rng(0, "chair", "88382b87").uniform()
    >>> first == instance_rng(0, "chair", "88382b87").uniform()
    True
    >>> first == instance_rng(0, "chair", "341c9b05").uniform()
    False
    """
    digest = hashlib.sha256("\0".join(names).encode()).digest()
    words = np.frombuffer(digest[:16], dtype=np.uint32)
    return np.random.default_rng([seed, *words.tolist()])
