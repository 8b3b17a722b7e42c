"""Values that no argument should have, and values that are made from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

_NUMBERS: list[Any] = [
    0, -0.0, -1, 1, 2, 0.3, 1e-200, 1e-12, 1e12, 1e200, 1e308, 5e-324, math.nan, math.inf,
    -math.inf,
    10**400, 10**5000, -(10**400), 2**31, 2**63, 2**64, np.float32(2), np.float16(1e-7),
    np.int8(-1), np.uint64(2**64 - 1), np.float64("nan"), np.longdouble(1), np.bool_(True),
    np.complex128(1 + 2j), 1j, True, False,
]  # fmt: skip
_OTHERS: list[Any] = [
    None, "", "x", "0.3", "huber", "optimal", "yz", "zy", "estimate", "\x1b[31m\n\0", "a" * 10**5,
    "9" * 6000, b"", b"1", [], {}, (), [1.0], [None], ["huber"], {"a": 1}, {1, 2}, object(), object,
    len, iter([1, 2]), range(8), slice(2), Ellipsis, NotImplemented,
]  # fmt: skip


@dataclass(frozen=True)
class Call:
    """A value yet to be made, since making it may be refused."""

    kind: Callable[..., Any]
    arguments: Mapping[str, Any]


def made(value: Any) -> Any:
    """The value of a `Call`, or the value itself."""
    return value.kind(**value.arguments) if isinstance(value, Call) else value


def draw_value(rng: np.random.Generator) -> Any:
    """Draw anything at all: more numbers than other values, and arrays of all kinds."""
    choice = rng.random()
    if choice < 0.5:
        return _NUMBERS[rng.integers(len(_NUMBERS))]
    if choice < 0.75:
        return _OTHERS[rng.integers(len(_OTHERS))]
    return draw_array(rng, tuple(rng.integers(0, 9, rng.integers(0, 4)).tolist()))


def draw_array(rng: np.random.Generator, shape: tuple[int, ...]) -> Any:
    """Draw an array of some shape that is not quite one of floats."""
    plain = rng.uniform(-1, 1, shape)
    with np.errstate(all="ignore"):
        kinds: list[Callable[[], Any]] = [
            lambda: plain,
            lambda: np.abs(plain),
            lambda: plain.astype(np.float32),
            lambda: plain.astype(np.float16) * np.float16(6e4),
            lambda: (plain * 100).astype(np.int8),
            lambda: plain.astype(np.longdouble),
            lambda: plain.astype(complex),
            lambda: plain.astype(object),
            lambda: np.full(shape, None),
            lambda: np.full(shape, 10**400),
            lambda: plain.astype(str),
            lambda: plain.astype("S"),
            lambda: plain > 0,
            lambda: (plain * 100).astype("m8[s]"),
            lambda: (plain * 100).astype("M8[s]"),
            lambda: np.zeros(shape, dtype=[("a", float)]),
            lambda: np.ma.masked_greater(plain, 0.5),
            lambda: np.ma.array(plain),
            lambda: plain.tolist(),
            lambda: tuple(plain) if plain.ndim else (float(plain),),
            lambda: [plain.tolist(), [1.0]],
            lambda: memoryview(plain) if plain.ndim else plain,
            lambda: np.asmatrix(plain) if plain.ndim == 2 else plain,
            lambda: plain.T,
            lambda: plain[::-1] if plain.ndim else plain,
            lambda: np.asfortranarray(plain),
            lambda: np.broadcast_to(0.5, shape),
            lambda: plain.astype(">f8"),
            lambda: np.frombuffer(plain.tobytes()).reshape(shape),
            lambda: iter(plain) if plain.ndim else plain,
        ]
        return kinds[rng.integers(len(kinds))]()
