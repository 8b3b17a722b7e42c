"""Atomic writes, reads of regular files of bounded size, sealed files; errors name the file."""

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
_MAX_PATH = 1000  # of a path that is shown whole
_SEAL = struct.Struct("<16sIIQ32s")
MOST_BYTES = 2**32
"""Size of the largest file that is read where its reader states no other."""
_kept: ContextVar[set[str] | None] = ContextVar("kept", default=None)


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file such that, killed at any moment, it is there whole or as it was.

    ``write`` writes the file that it is given the name of, in the same folder. Raises DataError if
    it cannot be written, or something is made from it (`keeping`).
    """
    with writing(path):
        refuse_folder(path)
        refuse_input(path)
        # Of a short name, whose ending is the true one: some writers go by it.
        name = f".unfinished-{os.getpid()}-{hash(path.name):x}{path.suffix}"
        unfinished = path.with_name(name)
        try:
            write(unfinished)
            os.replace(unfinished, path)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise


@contextmanager
def writing_folder(path: Path) -> Iterator[Path]:
    """Write, within the block, a folder such that it is there whole or as it was.

    What is written to the folder beside it that the block is given takes its place at the end. It
    must be empty, if it is there.
    """
    import tempfile

    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not a plain folder name beside it: two runs at once must not share one.
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            unfinished = Path(folder, "unfinished")
            unfinished.mkdir()
            yield unfinished
            unfinished.replace(path)


@contextmanager
def keeping(inputs: Iterable[Path | None]) -> Iterator[None]:
    """Refuse, within the block, to write over the files that something is made from.

    Whatever writes files goes by it: also those beside the one that somebody names.
    """
    named = {path for path in inputs if path is not None}
    for path in named:
        refuse_nul(path)
    token = _kept.set((_kept.get() or set()) | {os.path.realpath(path) for path in named})
    try:
        yield
    finally:
        _kept.reset(token)


def keep(path: Path) -> None:
    """Refuse to write over a further file to the end of the innermost block of `keeping`."""
    kept = _kept.get()
    if kept is not None:
        kept.add(os.path.realpath(path))


def refuse_input(path: Path) -> None:
    """Raise a DataError for a file that must not be written over; see `keeping`."""
    if os.path.realpath(path) in (_kept.get() or ()):
        what = "what is to be written is made from this file"
        raise DataError(what, where=printable(path), fix="give another name")


@contextmanager
def locked(path: Path, what: str, *, fix: str) -> Iterator[None]:
    """Hold a folder's lock file; a killed process holds none.

    Raises a DataError of the folder, which says ``what``, if another process holds it.
    """
    with writing(path.parent):
        lock = path.open("a")
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DataError(what, where=str(path.parent), fix=fix) from None
        yield


def refuse_folder(path: Path) -> None:
    """Raise a DataError for a folder in the place of a file that is to be written."""
    if not path.name or path.is_dir():
        raise DataError("is a folder", where=printable(path), fix="give a file's name")


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all; see `write_whole`."""
    write_whole(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file whole or not at all; see `write_whole`."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def dense_json(value: Any) -> str:
    """JSON without blanks; numbers that are not finite become null."""
    return json.dumps(finite(value), separators=(",", ":"))


def finite(value: Any) -> Any:
    """Lists and mappings with None in the place of numbers that are not finite."""
    return json.loads(json.dumps(value), parse_constant=lambda _: None)


def damaged(what: str, where: object = None) -> DataError:
    """The error of a file whose content cannot be that of a whole file."""
    fix = "the file is cut short or damaged; get it again"
    return DataError(what, where=None if where is None else str(where), fix=fix)


def require_count(what: str, announced: int, found: int, surplus: int, path: Path) -> None:
    """Raise a DataError for a file with less than it announces; warn of bytes behind its data."""
    if found < announced:
        raise damaged(f"the header announces {announced} {what}, but only {found} are there", path)
    if surplus:
        logger.warning("%s: %d bytes behind its data are left out", path, surplus)


def as_path(given: object, where: str = "path") -> Path:
    """A path that somebody gives as an argument ``where``; an InputError if it is none."""
    text = os.fspath(given) if isinstance(given, str | os.PathLike) else None
    if not isinstance(text, str):
        what = f"expected a path, got {type(given).__name__} {quote(given)}"
        raise InputError(what, where=where, fix="give a str or a pathlib.Path")
    return Path(text)


def listed(folder: Path, pattern: str | None = None) -> list[Path]:
    """The entries of a folder, or those that match a pattern, sorted, without hidden ones.

    Archives made on a Mac have a hidden file ``._a.mat`` beside each ``a.mat``, which is none.
    """
    entries = folder.iterdir() if pattern is None else folder.glob(pattern)
    return sorted(path for path in entries if path.name[0] != ".")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Convert errors of the file system, and of text that is not UTF-8, to `DataError`."""
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

    Every file that somebody names is opened here: a device has no end, and a pipe may have no other
    end.

    Raises DataError if it is missing, no regular file, larger, or cannot be read.
    """
    path = as_path(path)
    with reading(path), open(path, "rb", opener=_opened_at_once) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            fix = "give a file, no pipe and no device"
            raise DataError("not a regular file", where=printable(path), fix=fix)
        if status.st_size > most:
            what = f"{status.st_size} bytes, more than the {most} that are read of such a file"
            raise DataError(what, where=printable(path))
        yield file


def _opened_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)  # of a pipe, it would wait for the other end


def once_per_file(most: int) -> Callable[[F], F]:
    """Remember what a reader gives of so many files, each until it is written anew."""

    def remembering(read: F) -> F:
        remembered = lru_cache(most)(lambda path, written, **given: read(path, **given))

        @wraps(read)
        def opened(path: Path, **given: Any) -> Any:
            path = as_path(path)
            try:
                written = path.stat().st_mtime_ns
            except (OSError, ValueError):  # which the reader says
                written = 0
            return remembered(path, written, **given)

        return cast(F, opened)

    return remembering


def read_bytes(path: Path, *, most: int = MOST_BYTES) -> bytes:
    """Read a regular file of at most ``most`` bytes; see `open_input`."""
    with open_input(path, most=most) as file:
        # No more than it has at its opening: some files of the system grow without end.
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, *, most: int = MOST_BYTES, errors: str = "strict") -> str:
    """Read a regular text file, UTF-8 with or without a mark; see `open_input`."""
    data = read_bytes(path, most=most)
    with reading(path):
        text = data.decode("utf-8-sig", errors=errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert errors of the file system to `DataError`."""
    refuse_nul(path)
    try:
        yield
    except OSError as error:
        # The text of other libraries' errors names the system's only among much else.
        reason = os.strerror(error.errno) if error.errno else error
        raise DataError(
            f"cannot be written ({reason})",
            where=str(path),
            fix="make room or choose another folder; what was written before is kept",
        ) from None


def made_folder(path: Path) -> Path:
    """Make a folder, with those above it; returns it."""
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
    return path


def printable(path: Path | str) -> str:
    """A path for a message, quoted where a terminal does not show it, shortened where endless."""
    text = str(path)
    return text if text.isprintable() and len(text) <= _MAX_PATH else quote(text)


def refuse_nul(path: Path) -> None:
    """Raise a DataError for a path with a NUL: the file system's ValueError does not name it."""
    if "\0" in str(path):
        raise DataError("the path holds a NUL character", where=printable(path))


def require_utf8(path: Path) -> None:
    """Refuse a path that no JSON file and no table can hold: names of old disks may be no UTF-8."""
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError:
        fix = "rename it, or the folder that it is in"
        raise DataError("the path is not UTF-8", where=printable(path), fix=fix) from None


def checksum(payload: Any) -> bytes:
    """BLAKE2b checksum of 32 bytes."""
    return hashlib.blake2b(payload, digest_size=32).digest()


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
        header = _SEAL.pack(self.magic, self.version, 0, size, checksum(payload))
        write_whole(path, lambda unfinished: unfinished.write_bytes(header + payload))

    def unwrap(self, content: Any, where: str) -> memoryview:
        """Check the header and the checksum; returns the payload, which is not copied.

        Raises DataError if the content is of another format or version, cut short or damaged.
        """
        view = memoryview(content).cast("B")
        if len(view) < _SEAL.size or bytes(view[:16]) != self.magic:
            raise DataError(f"not a {self.noun}", where=where, fix=self.fix)
        _, version, _, size, expected = _SEAL.unpack(view[: _SEAL.size])
        payload = view[_SEAL.size :]
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
