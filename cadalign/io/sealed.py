"""Sealed files: a header of 64 bytes with format, version and checksum, then the payload.

The header holds, in little-endian order::

    16 bytes   a text that names the format
     4 bytes   version of the format
     4 bytes   zero
     8 bytes   length of the payload
    32 bytes   BLAKE2b checksum of the payload
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadalign.errors import DataError
from cadalign.io.files import write_whole

_HEADER = struct.Struct("<16sIIQ32s")


@dataclass(frozen=True)
class Seal:
    """One format of sealed files.

    Parameters
    ----------
    magic : bytes
        The 16 bytes that name it.
    version : int
        The version that is written and read.
    noun : str
        Its name in messages, such as "library file".
    fix : str
        How to make such a file.
    """

    magic: bytes
    version: int
    noun: str
    fix: str

    def write(self, path: Path, payload: Any) -> None:
        """Write a file atomically; ``payload`` is bytes or a buffer."""
        size = memoryview(payload).nbytes
        header = _HEADER.pack(self.magic, self.version, 0, size, checksum(payload))

        def write(unfinished: Path) -> None:
            with unfinished.open("wb") as file:
                file.write(header)
                file.write(payload)

        write_whole(path, write)

    def unwrap(self, content: Any, where: str) -> memoryview:
        """Check the header and the checksum; returns the payload, which is not copied.

        Raises
        ------
        DataError
            If the content is of another format or version, truncated or damaged.
        """
        view = memoryview(content).cast("B")
        if len(view) < _HEADER.size or bytes(view[:16]) != self.magic:
            raise DataError(f"not a {self.noun}", where=where, fix=self.fix)
        _, version, _, size, expected = _HEADER.unpack(view[: _HEADER.size])
        payload = view[_HEADER.size :]
        if version != self.version:
            raise DataError(
                f"a {self.noun} of version {version}, but this cadalign reads version "
                f"{self.version}",
                where=where,
                fix=self.fix,
            )
        if len(payload) != size:
            what = "truncated" if len(payload) < size else "too long"
            raise self.error(f"is {what}: {len(payload)} bytes, {size} expected", where, again=True)
        if checksum(payload) != expected:
            raise self.error("is damaged: its checksum is wrong", where, again=True)
        return payload

    def error(self, what: str, where: str, *, again: bool = False) -> DataError:
        """The error of a file whose content is wrong."""
        fix = f"copy it again, or {self.fix}" if again else self.fix
        return DataError(f"the {self.noun} {what}", where=where, fix=fix)


def checksum(payload: Any) -> bytes:
    """BLAKE2b checksum of 32 bytes."""
    return hashlib.blake2b(payload, digest_size=32).digest()
