"""Sealed files: round trip, and errors for damaged files."""

from __future__ import annotations

from pathlib import Path

import pytest

from cadalign.errors import DataError
from cadalign.io.files import Seal

SEAL = Seal(b"cadalign tests\0\0", 3, "test file", "write it again")


def written(folder: Path, payload: bytes = b"some payload") -> bytes:
    SEAL.write(folder / "sealed", payload)
    return (folder / "sealed").read_bytes()


@pytest.mark.parametrize("payload", [b"", b"some payload", bytes(range(256))])
def test_payloads_round_trip(tmp_path: Path, payload: bytes) -> None:
    assert bytes(SEAL.unwrap(written(tmp_path, payload), "sealed")) == payload


@pytest.mark.parametrize(
    ("place", "message"),
    [(-1, "the checksum is wrong"), (40, "the checksum is wrong"), (0, "not a test file")],
    ids=["payload", "checksum", "magic"],
)
def test_a_changed_byte_is_noticed(tmp_path: Path, place: int, message: str) -> None:
    content = bytearray(written(tmp_path))
    content[place] ^= 1
    with pytest.raises(DataError, match=message):
        SEAL.unwrap(bytes(content), "sealed")


def test_lengths_are_checked(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = written(tmp_path)
    with pytest.raises(DataError, match="announces 12 bytes, but only 11 are there"):
        SEAL.unwrap(content[:-1], "sealed")
    assert bytes(SEAL.unwrap(content + b"x", "sealed")) == b"some payload"
    assert caplog.messages == ["sealed: 1 bytes after its data are ignored"]
