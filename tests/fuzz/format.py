"""What is fuzzed: a small valid file of a format, and its reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Format:
    """One file format.

    Parameters
    ----------
    name : str
    write : callable
        Writes a valid file, and what goes with it, into a folder; returns the file to mutate.
    read : callable
        Reads that file.
    seal : callable
        Makes the checksum of mutated data right again, where the format has one.
    """

    name: str
    write: Callable[[Path], Path]
    read: Callable[[Path], object]
    seal: Callable[[bytes], bytes] = bytes
