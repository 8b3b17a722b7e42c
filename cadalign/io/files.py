"""Atomic writes, reads of regular files of limited size, sealed files; errors name the file."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import stat
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, BinaryIO, TypeVar, cast

from cadalign.errors import DataError, InputError, quote

logger = logging.getLogger("cadalign")

F = TypeVar("F", bound=Callable[..., Any])
_MAX_PATH = 1000  # length of a path that is shown in full
_SEAL = struct.Struct("<16sIIQ32s")
MOST_BYTES = 2**32
"""Default limit of the size of files that are read."""
_kept: ContextVar[set[str] | None] = ContextVar("kept", default=None)


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file atomically: if the process is killed, the file is complete or unchanged.

    ``write`` receives the path of a temporary file in the same folder, and writes it. Raises
    DataError if the file cannot be written, or is an input (see `protect_inputs`).
    """
    with guard_writing(path):
        refuse_folder(path)
        refuse_input(path)
        # A short name with the same ending, by which some writers choose the format.
        name = f".unfinished-{os.getpid()}-{hash(path.name):x}{path.suffix}"
        unfinished = path.with_name(name)
        try:
            write(unfinished)
            os.replace(unfinished, path)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise


@contextmanager
def protect_inputs(inputs: Iterable[Path | None]) -> Iterator[None]:
    """Protect input files: within the block, overwriting them raises DataError.

    All functions that write files check it, also for files beside the named output.
    """
    named = {path for path in inputs if path is not None}
    for path in named:
        refuse_nul(path)
    token = _kept.set((_kept.get() or set()) | {os.path.realpath(path) for path in named})
    try:
        yield
    finally:
        _kept.reset(token)


def protect_input(path: Path) -> None:
    """Protect a further input file until the end of the innermost `protect_inputs` block."""
    kept = _kept.get()
    if kept is not None:
        kept.add(os.path.realpath(path))


def refuse_input(path: Path) -> None:
    """Raise a DataError if a file is protected; see `protect_inputs`."""
    if os.path.realpath(path) in (_kept.get() or ()):
        what = "this file is an input and would be overwritten"
        raise DataError(what, where=printable(path), fix="give another name")


@contextmanager
def hold_lock(path: Path, what: str, *, fix: str) -> Iterator[None]:
    """Hold a folder's lock file; the system releases it if the process is killed.

    Raises a DataError of text ``what`` that names the folder if another process holds it.
    """
    with guard_writing(path.parent):
        lock = path.open("a")
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DataError(what, where=str(path.parent), fix=fix) from None
        yield


def refuse_folder(path: Path) -> None:
    """Raise a DataError if the path of a file to write is a folder."""
    if not path.name or path.is_dir():
        raise DataError("is a folder", where=printable(path), fix="give a file's name")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically; see `write_whole`."""
    write_whole(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically; see `write_whole`."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def dense_json(value: Any) -> str:
    """Convert to JSON without blanks; numbers that are not finite become null."""
    return json.dumps(finite(value), separators=(",", ":"))


def finite(value: Any) -> Any:
    """Replace numbers that are not finite by None in nested lists and mappings."""
    return json.loads(json.dumps(value), parse_constant=lambda _: None)


def damage_error(what: str, where: object = None) -> DataError:
    """Return the error for a file whose content is incomplete or damaged."""
    fix = "the file is cut short or damaged; get it again"
    return DataError(what, where=None if where is None else str(where), fix=fix)


def require_count(what: str, announced: int, found: int, surplus: int, path: Path) -> None:
    """Raise a DataError if a file has less than its header announces; warn of surplus bytes."""
    if found < announced:
        raise damage_error(
            f"the header announces {announced} {what}, but only {found} are there", path
        )
    if surplus:
        logger.warning("%s: %d bytes after its data are ignored", path, surplus)


def as_path(given: object, where: str = "path") -> Path:
    """Convert the argument named ``where`` to a path; raises InputError if it is not a path."""
    text = os.fspath(given) if isinstance(given, str | os.PathLike) else None
    if not isinstance(text, str):
        what = f"expected a path, got {type(given).__name__} {quote(given)}"
        raise InputError(what, where=where, fix="give a str or a pathlib.Path")
    return Path(text)


def list_folder(folder: Path, pattern: str | None = None) -> list[Path]:
    """List a folder's entries, or those that match a pattern, sorted, without hidden ones.

    Archives made on a Mac have a hidden file ``._a.mat`` beside ``a.mat``, of another format.
    """
    entries = folder.iterdir() if pattern is None else folder.glob(pattern)
    return sorted(path for path in entries if path.name[0] != ".")


@contextmanager
def guard_reading(path: Path) -> Iterator[None]:
    """Convert errors of the file system and of UTF-8 decoding to `DataError`."""
    refuse_nul(path)
    try:
        yield
    except FileNotFoundError:
        raise DataError("no such file", where=printable(path)) from None
    except UnicodeDecodeError as error:
        what = f"cannot be read as text: byte {error.start} is not UTF-8"
        raise DataError(what, where=printable(path)) from None
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"cannot be read ({reason})", where=printable(path)) from None


@contextmanager
def open_input(path: Path, *, most: int = MOST_BYTES) -> Iterator[BinaryIO]:
    """Open a regular file of at most ``most`` bytes.

    All input files are opened here, because reading a device may never end, and opening a pipe may
    block.

    Raises DataError if the file is missing, not regular, larger, or cannot be read.
    """
    path = as_path(path)
    with guard_reading(path), open(path, "rb", opener=_open_nonblocking) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            fix = "give a regular file, not a pipe or device"
            raise DataError("not a regular file", where=printable(path), fix=fix)
        if status.st_size > most:
            what = f"the file has {status.st_size} bytes, more than the limit of {most}"
            raise DataError(what, where=printable(path))
        yield file


def _open_nonblocking(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)  # opening a pipe would wait for a writer


def once_per_file(most: int) -> Callable[[F], F]:
    """Cache a reader's results for up to ``most`` files, each until the file is changed."""

    def decorate(read: F) -> F:
        cached = lru_cache(most)(lambda path, written, **given: read(path, **given))

        @wraps(read)
        def wrapped(path: Path, **given: Any) -> Any:
            path = as_path(path)
            try:
                written = path.stat().st_mtime_ns
            except (OSError, ValueError):  # the reader raises it again
                written = 0
            return cached(path, written, **given)

        return cast(F, wrapped)

    return decorate


def read_bytes(path: Path, *, most: int = MOST_BYTES) -> bytes:
    """Read a regular file of at most ``most`` bytes; see `open_input`."""
    with open_input(path, most=most) as file:
        # Not more than the size at opening: a file may grow without end.
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, *, most: int = MOST_BYTES, errors: str = "strict") -> str:
    """Read a regular text file, UTF-8 with or without byte order mark; see `open_input`."""
    data = read_bytes(path, most=most)
    with guard_reading(path):
        text = data.decode("utf-8-sig", errors=errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")


@contextmanager
def guard_writing(path: Path) -> Iterator[None]:
    """Convert errors of the file system to `DataError`."""
    refuse_nul(path)
    try:
        yield
    except OSError as error:
        # Messages of other libraries bury the system's reason in other text.
        reason = os.strerror(error.errno) if error.errno else error
        raise DataError(
            f"cannot be written ({reason})",
            where=str(path),
            fix="make room or choose another folder; what was written before is kept",
        ) from None


def create_folder(path: Path) -> Path:
    """Create a folder and its parents; returns it."""
    with guard_writing(path):
        path.mkdir(parents=True, exist_ok=True)
    return path


def printable(path: Path | str) -> str:
    """Format a path for a message: quoted if it is not printable, shortened if it is long."""
    text = str(path)
    return text if text.isprintable() and len(text) <= _MAX_PATH else quote(text)


def refuse_nul(path: Path) -> None:
    """Raise a DataError if a path has a NUL; Python's ValueError would not name the path."""
    if "\0" in str(path):
        raise DataError("the path holds a NUL character", where=printable(path))


def require_utf8(path: Path) -> None:
    """Raise a DataError if a path is not UTF-8: JSON files and tables cannot hold it."""
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError:
        fix = "rename the file or its folder"
        raise DataError("the path is not UTF-8", where=printable(path), fix=fix) from None


def checksum(payload: Any) -> bytes:
    """Compute the BLAKE2b checksum of 32 bytes."""
    return hashlib.blake2b(payload, digest_size=32).digest()


@dataclass(frozen=True)
class Seal:
    """One format of sealed files: a header of 64 bytes, then the payload.

    The header is little-endian: the format's magic (16 bytes), its version (4 bytes), zero (4
    bytes), the payload's length (8 bytes) and its BLAKE2b checksum (32 bytes).
    """

    magic: bytes  # 16 bytes
    version: int  # the only version that is written and read
    noun: str  # the format's name in messages, such as "library file"
    fix: str  # instruction for creating such a file

    def write(self, path: Path, payload: Any) -> None:
        """Write a file atomically; ``payload`` is bytes or a buffer."""
        size = memoryview(payload).nbytes
        header = _SEAL.pack(self.magic, self.version, 0, size, checksum(payload))
        write_whole(path, lambda unfinished: unfinished.write_bytes(header + payload))

    def unwrap(self, content: Any, where: str) -> memoryview:
        """Check the header and the checksum; returns a view of the payload.

        Raises DataError if the content has another format or version, is cut short or damaged.
        """
        view = memoryview(content).cast("B")
        if len(view) < _SEAL.size or bytes(view[:16]) != self.magic:
            raise DataError(f"not a {self.noun}", where=where, fix=self.fix)
        _, version, _, size, expected = _SEAL.unpack(view[: _SEAL.size])
        payload = view[_SEAL.size :]
        if version != self.version:
            what = f"has version {version}, but this cadalign reads version {self.version}"
            raise self.error(what, where)
        require_count("bytes", size, len(payload), len(payload) - size, Path(where))
        if checksum(payload[:size]) != expected:
            raise damage_error("the checksum is wrong", where)
        return payload[:size]

    def error(self, what: str, where: str) -> DataError:
        """Return the error for a file with invalid content."""
        return DataError(f"the {self.noun} {what}", where=where, fix=self.fix)
