"""One writer at a time: locks of processes on files, claims of browsers on photos.

Locks end with their process, also if it is killed. An annotator of one photo holds a lock for each
file that it writes, an annotator of a folder the folder's own. Both pass through the folder's lock,
so that neither overlooks the other.
"""

from __future__ import annotations

import errno
import logging
import os
import platform
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from filelock import FileLock, Timeout

from cadalign.annotate.names import file_name
from cadalign.errors import DataError, InputError
from cadalign.io.files import checksum, read_bytes, read_text

logger = logging.getLogger("cadalign")

LEASE = 60.0
"""Time that a photo stays with the person who changed it last [s]."""
_ENDING = "annotate-lock"
_PATIENCE = 0.2  # for a lock that is just being removed [s]
_QUEUE = 2.0  # for others that are passing through the folder's lock [s]
_LONGEST_NOTE = 150
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)


@dataclass
class LastContent:
    """The content of a file as it was last read or written: who changes it is no annotator."""

    _known: bytes | None = None  # its checksum; None without a file

    def note(self, path: Path) -> None:
        """Remember the content of the file, or that there is none."""
        self._known = _content(path)

    def refuse_changed(self, path: Path) -> None:
        """Raise DataError if the file has other content by now."""
        if _content(path) not in (None, self._known):
            what = "was changed by another program since the annotator read or wrote it"
            fix = "rename it to have all marks saved, or start anew to go on with that file"
            raise DataError(what, where=str(path), fix=fix)


class WriterLocks:
    """Locks on the files of one folder that a session writes, as a context.

    ``whole_folder`` holds the folder's lock in place of one for each file. The address of the
    session's page is for the message to others.
    """

    def __init__(self, files: Sequence[Path], *, whole_folder: bool, address: str) -> None:
        self._files = {_lock_path(file): file for file in files}
        self._folder = files[0].parent
        self._whole_folder = whole_folder
        self._note = f"{address}, process {os.getpid()} on {platform.node()}"
        self._held = ExitStack()
        self._locks: list[_Lock] = []

    def __enter__(self) -> Self:
        """Lock the files; raises DataError if another annotator has one of them."""
        self._take(self._files)
        return self

    def __exit__(self, *error: object) -> None:
        """Unlock the files."""
        self._release()

    def confirm(self) -> None:
        """Lock the files anew if their locks are gone, such as with a deleted folder.

        Raises DataError if another annotator has one of them by now.
        """
        if not self._locks or not all(lock.intact for lock in self._locks):
            self._release()
            self._take(self._files)

    def reserve(self, files: Sequence[Path]) -> None:
        """Lock further files of the folder that the session writes.

        Raises DataError if another annotator has one of them.
        """
        new = {_lock_path(file): file for file in files if _lock_path(file) not in self._files}
        if new and not self._whole_folder:
            self._take(new)
            self._files |= new

    def _take(self, files: Mapping[Path, Path]) -> None:
        """Hold the locks of files by their lock files, all or none."""
        with ExitStack() as passing, ExitStack() as held:
            gate = _Lock(self._folder / f".{_ENDING}", self._folder, self._note)
            (held if self._whole_folder else passing).enter_context(gate.hold(_QUEUE))
            taken = [gate] if self._whole_folder else []
            for path, file in files.items():
                lock = _Lock(path, file, self._note)
                if not self._whole_folder:
                    held.enter_context(lock.hold(_PATIENCE))
                    taken.append(lock)
                elif path.exists():
                    passing.enter_context(lock.hold(_PATIENCE))
            self._locks += taken
            self._held.enter_context(held.pop_all())

    def _release(self) -> None:
        self._locks = []
        self._held.close()


class _Lock:
    """Lock file with a note on its holder."""

    def __init__(self, path: Path, file: Path, note: str) -> None:
        self._path = path
        self._file = file
        self._note = note
        self._identity: tuple[int, int] | None = None

    @property
    def intact(self) -> bool:
        """False if the lock file was removed or replaced, so that it keeps nobody off."""
        return self._identity is None or self._identity == _identity(self._path)

    @contextmanager
    def hold(self, timeout: float) -> Iterator[None]:
        """Hold the lock; raises DataError if another has it, or the folder cannot be written to."""
        if not self._path.parent.is_dir():  # which FileLock would make
            raise DataError(
                "the folder is gone",
                where=str(self._path.parent),
                fix="put it back: everything is saved with the next change, or at the end",
            )
        lock = FileLock(self._path, timeout=timeout, thread_local=False)
        try:
            lock.acquire()
        except Timeout:
            raise self._refusal() from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise self._unwritable(error.strerror or str(error)) from None
            logger.warning("%s: no locks here: use one annotator only", self._path.parent)
            yield
            return
        try:
            with suppress(OSError):  # Windows lets nobody write to a locked file
                self._path.write_text(self._note, encoding="utf-8")
            self._identity = _identity(self._path)
            yield
        finally:
            if self.intact:
                with suppress(OSError):
                    self._path.unlink()  # while it is held: whoever waits for it notices
            lock.release()

    def _refusal(self) -> DataError:
        note = ""
        try:
            if not self._path.exists():
                return self._unwritable("No lock can be made")
            note = read_text(self._path, errors="replace")[:_LONGEST_NOTE]
        except (OSError, DataError):
            pass
        return DataError(
            "another annotator has it open" + (f": {note}" if note else ""),
            where=str(self._file),
            fix="go on in its page or end it, or give another --observation or --out",
        )

    def _unwritable(self, reason: str) -> DataError:
        return DataError(
            f"the folder cannot be written to ({reason})",
            where=str(self._path.parent),
            fix="make it writable, or choose another one by --out",
        )


def _lock_path(file: Path) -> Path:
    # Without the ending: files that differ only in that share those derived from them.
    return file.with_name(file_name(f".{file.stem}", f".{_ENDING}"))


def _content(path: Path) -> bytes | None:
    return checksum(read_bytes(path)) if path.exists() else None


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


@dataclass(frozen=True)
class _Claim:
    browser: str
    person: str
    since: float


class Claims:
    """Claims of browsers on the photos that they change.

    Another browser of the same person takes a claim over at once, another person after `LEASE`.
    ``clock`` gives the seconds since any moment.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._claims: dict[int, _Claim] = {}

    def take(self, photos: Collection[int], browser: str, person: str) -> None:
        """Claim photos for a browser, all or none, or renew its claims.

        Raises InputError if another person has changed one of them within the last `LEASE` seconds.
        """
        now = self._clock()
        for claim in (self._claims[photo] for photo in photos if photo in self._claims):
            left = claim.since + LEASE - now
            if claim.person != person and left > 0:
                raise InputError(
                    "someone else is annotating this photo, so that your change is not made",
                    where="photo",
                    fix=f"take another one, or try again {left:.0f} s after their last change",
                )
        for photo in photos:
            self._claims[photo] = _Claim(browser, person, now)

    def is_elsewhere(self, photo: int, browser: str) -> bool:
        """True while a photo belongs to another browser."""
        claim = self._claims.get(photo)
        if claim is None or claim.browser == browser:
            return False
        return self._clock() < claim.since + LEASE
