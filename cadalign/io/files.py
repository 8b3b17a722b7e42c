"""Atomic writes: a file is there whole or as it was, and errors name it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cadalign.errors import DataError, quote

_MAX_NAME = 50  # such that the unfinished file's name stays below the 255 bytes of file systems


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file such that, killed at any moment, it is there whole or as it was.

    ``write`` writes the file that it is given the name of, in the same folder.
    """
    # The true ending stays last: some writers go by it.
    name = path.name if len(path.name) <= _MAX_NAME else f"{hash(path.name):x}{path.suffix}"
    with writing(path):
        unfinished = path.with_name(f".unfinished-{os.getpid()}-{name}")
        try:
            write(unfinished)
            os.replace(unfinished, path)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all; see `write_whole`."""
    write_whole(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file whole or not at all; see `write_whole`."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def dense_json(value: Any) -> str:
    """JSON without blanks; numbers that are not finite become null."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), separators=(",", ":"))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def damaged(what: str, where: object) -> DataError:
    """The error of a file whose content cannot be that of a whole file."""
    fix = "the file is cut short or damaged; get it again"
    return DataError(what, where=str(where), fix=fix)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Convert errors of the file system, and of text that is not UTF-8, to `DataError`."""
    refuse_nul(path)
    try:
        yield
    except FileNotFoundError:
        raise DataError("no such file", where=str(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"cannot be read ({reason})", where=str(path)) from None


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert errors of the file system to `DataError`."""
    refuse_nul(path)
    try:
        yield
    except OSError as error:
        raise DataError(
            f"cannot be written ({error.strerror or error})",
            where=str(path),
            fix="make room or choose another folder; what was written before is kept",
        ) from None


def printable(path: Path | str) -> str:
    """A path for a message, quoted where it holds what a terminal does not show."""
    text = str(path)
    return text if text.isprintable() else quote(text)


def refuse_nul(path: Path) -> None:
    """Raise a DataError for a path with a NUL: the file system's ValueError does not name it."""
    if "\0" in str(path):
        raise DataError("the path holds a NUL character", where=printable(path))
