"""Mutated files: what changes in them, and the bounds in which they are read."""

from __future__ import annotations

import copy
import json
import logging
import re
import resource
import signal
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cadalign import CadalignError

MEMORY = 500 << 20
SECONDS = 10
LONGEST_MESSAGE = 2000
_TEXTS = [
    b"0", b"-1", b"1e999", b"nan", b"1e308", b"2147483648", b"9223372036854775808", b"99999999",
    b"0.1.2", b"", b"null", b"\xff\xfe", b"[" * 2000, b"9" * 5000, b"-0", b"true", b'"', b"{",
    b"1e-320", b"4294967295", b"\x1b[2J", b"\0", b"-inf", b"1" + b"0" * 400, b"\r", b"\n\n", b"1_0",
    "\u0661".encode(),
]  # fmt: skip
_VALUES: list[Any] = [
    None, True, 0, -1, 1e308, 1e-320, 2**31, 2**63, 2**64, 10**400, float("nan"), float("inf"), "",
    "x", "1", "\ud800", "\0", "a" * 5000, "../../../etc/passwd", "/dev/zero", [], {}, [[]], [None],
    [0] * 1000, {"a": {"a": {}}}, [1, [2]],
]  # fmt: skip
_NUMBERS = [
    struct.pack(form, value)
    for form, values in (
        ("<i", (0, -1, 1, 2**31 - 1, -(2**31), 2**28, 65536)),
        ("<q", (0, -1, 1, 2**63 - 1, -(2**63), 2**32, 2**40)),
        ("<d", (0.0, -1.0, 1e308, 1e-320, float("nan"), float("inf"))),
        ("<f", (float("nan"), float("-inf"), 1e38)),
        (">i", (-1, 2**31 - 1, 2**28)),
    )
    for value in values
]


@dataclass(frozen=True)
class Format:
    """What is fuzzed: a small valid file of a format, and its reader.

    ``write`` gives the file to mutate, in a folder with what goes with it; ``seal`` makes the
    checksum of mutated data right again, where the format has one.
    """

    name: str
    write: Callable[[Path], Path]
    read: Callable[[Path], object]
    seal: Callable[[bytes], bytes] = bytes


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a file in one place or a few: its bytes, or the values of a JSON document."""
    if rng.random() < 0.5 and (changed := _with_other_values(data, rng)) is not None:
        return changed
    for _ in range(int(rng.geometric(0.6))):
        data = _MUTATIONS[rng.integers(len(_MUTATIONS))](data, rng)
    return data


class MutatedFiles:
    """Mutations of a format's file, each from a seed, in an empty folder of their own."""

    def __init__(self, kind: Format, folder: Path) -> None:
        self.kind = kind
        self.path = kind.write(folder)
        self.data = self.path.read_bytes()

    def run(self, seed: int) -> str:
        """Read the mutation of a seed; returns ``"read"`` or ``"refused"``.

        Anything but a `CadalignError`, a Python warning too, passes through.
        """
        rng = np.random.default_rng([seed, len(self.kind.name)])
        self.path.write_bytes(self.kind.seal(mutate(self.data, rng)))
        with bounded(), warnings.catch_warnings(), _short_messages():
            warnings.simplefilter("error")
            try:
                self.kind.read(self.path)
            except CadalignError as error:
                assert len(str(error)) < LONGEST_MESSAGE, "the message quotes its input at length"
                return "refused"
        return "read"


@contextmanager
def bounded() -> Iterator[None]:
    """Raise MemoryError and TimeoutError where a reader takes more than it should."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    previous = signal.signal(signal.SIGALRM, _too_long)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, before[1]))
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)
        resource.setrlimit(resource.RLIMIT_AS, before)


def _too_long(number: int, frame: object) -> None:
    raise TimeoutError(f"takes more than {SECONDS} s")


@contextmanager
def _short_messages() -> Iterator[None]:
    """Check that what is logged does not quote its input at length either."""
    longest = _Longest()
    logger = logging.getLogger("cadalign")
    logger.addHandler(longest)
    try:
        yield
    finally:
        logger.removeHandler(longest)
    assert longest.length < LONGEST_MESSAGE, "the log quotes its input at length"


class _Longest(logging.Handler):
    length = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.length = max(self.length, len(record.getMessage()))


# --- mutations -----------------------------------------------------------------------------------


def _place(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(len(data) + 1))
    return start, start + int(min(rng.geometric(0.05), len(data)))


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)[0]]


def _overwrite(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _place(data, rng)
    return data[:start] + rng.bytes(end - start) + data[end:]


def _remove(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _place(data, rng)
    return data[:start] + data[end:]


def _repeat(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _place(data, rng)
    return data[:start] + data[start:end] * int(rng.integers(2, 40)) + data[start:]


def _copy(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _place(data, rng)
    other = int(rng.integers(len(data) + 1))
    return data[:other] + data[start:end] + data[other:]


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    if not data:
        return data
    place = int(rng.integers(len(data)))
    flipped = bytes([data[place] ^ (1 << int(rng.integers(8)))])
    return data[:place] + flipped + data[place + 1 :]


def _replace_text(data: bytes, rng: np.random.Generator) -> bytes:
    """Put something else in the place of a number."""
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?([eE]-?\d+)?", data))
    if not numbers:
        return data
    chosen = numbers[rng.integers(len(numbers))]
    return data[: chosen.start()] + _TEXTS[rng.integers(len(_TEXTS))] + data[chosen.end() :]


def _replace_number(data: bytes, rng: np.random.Generator) -> bytes:
    """Put a binary number in the place of as many bytes."""
    number = _NUMBERS[rng.integers(len(_NUMBERS))]
    start = int(rng.integers(len(data) + 1))
    if rng.random() < 0.5:
        start -= start % 4
    return data[:start] + number + data[start + len(number) :]


_MUTATIONS: list[Callable[[bytes, np.random.Generator], bytes]] = [
    _cut, _overwrite, _remove, _repeat, _copy, _flip, _replace_text, _replace_text, _replace_number,
]  # fmt: skip


def _with_other_values(data: bytes, rng: np.random.Generator) -> bytes | None:
    """A JSON document with one or two values replaced, removed or doubled; None of another file."""
    try:
        document = json.loads(data)
    except ValueError:
        return None
    for _ in range(int(rng.integers(1, 3))):
        places = list(_places(document))
        if not places:
            break
        holder, key = places[rng.integers(len(places))]
        match rng.integers(4):
            case 0:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.insert(key, holder[key])
            case _:
                holder[key] = copy.deepcopy(_VALUES[rng.integers(len(_VALUES))])
    return json.dumps(document).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """All places of a document that hold a value: the list or object, and the index or key."""
    keys = range(len(value)) if isinstance(value, list) else list(value)
    for key in keys:
        yield value, key
        if isinstance(value[key], list | dict):
            yield from _places(value[key])
