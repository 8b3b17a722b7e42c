"""Sealed files: a header that names their format and version, and a checksum of what they hold."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadalign.errors import DataError
from cadalign.io.files import checksum, damaged, require_count, write_whole
from cadalign.io.kinds import kind_of_file

_HEADER = struct.Struct("<16sIIQ32s")


@dataclass(frozen=True)
class Seal:
    """One format of sealed files: a header of 64 bytes, then the payload.

    The header holds, in little-endian order, the 16 bytes that name the format, its version (4
    bytes), 4 bytes of zero, the payload's length (8 bytes) and its BLAKE2b checksum (32 bytes).
    """

    magic: bytes  # the 16 bytes
    version: int  # that is written and read
    noun: str  # its name in messages, such as "library file"
    fix: str  # how to make such a file

    def write(self, path: Path, payload: Any) -> None:
        """Write a file atomically; ``payload`` is bytes or a buffer."""
        size = memoryview(payload).nbytes
        header = _HEADER.pack(self.magic, self.version, 0, size, checksum(payload))
        write_whole(path, lambda unfinished: unfinished.write_bytes(header + payload))

    def unwrap(self, content: Any, where: str) -> memoryview:
        """Check the header and the checksum; returns the payload, which is not copied.

        Raises DataError if the content is of another format or version, cut short or damaged.
        """
        view = memoryview(content).cast("B")
        if len(view) < _HEADER.size or bytes(view[:16]) != self.magic:
            found = kind_of_file(Path(where))
            what = f"not a {self.noun}" if found is None else f"{found}, not a {self.noun}"
            raise DataError(what, where=where, fix=self.fix)
        _, version, _, size, expected = _HEADER.unpack(view[: _HEADER.size])
        payload = view[_HEADER.size :]
        if version != self.version:
            what = f"is of version {version}, but this cadalign reads version {self.version}"
            raise self.error(what, where)
        require_count("bytes", size, len(payload), len(payload) - size, Path(where))
        if checksum(payload[:size]) != expected:
            raise damaged("the checksum is wrong", where)
        return payload[:size]

    def error(self, what: str, where: str) -> DataError:
        """The error of a file whose content is wrong."""
        return DataError(f"the {self.noun} {what}", where=where, fix=self.fix)
