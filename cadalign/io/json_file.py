"""Reading JSON files and their fields, with errors that name the file and the field."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cadalign.arrays import as_floats
from cadalign.errors import CadalignError, DataError

_LARGEST_INDEX = 2**63 - 1


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises
    ------
    DataError
        If it is missing, cannot be read or is not JSON; names the line.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError("no such file", where=str(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot be read ({error})", where=str(path)) from None
    except json.JSONDecodeError as error:
        raise DataError(
            f"not valid JSON: {error.msg}", where=f"{path}, line {error.lineno}"
        ) from None
    except ValueError as error:  # a whole number of thousands of digits
        raise DataError(f"not valid JSON: {error}", where=str(path)) from None
    except RecursionError:
        raise DataError("not valid JSON: nested too deeply", where=str(path)) from None


@contextmanager
def in_file(path: Path) -> Iterator[None]:
    """Let errors about a file's content name the file."""
    try:
        yield
    except CadalignError as error:
        where = f"{path}: {error.where}" if error.where else str(path)
        raise DataError(error.what, where=where, fix=error.fix) from None


def as_object(value: Any, *, where: str | None) -> Mapping[str, Any]:
    """Refuse what is not a JSON object."""
    if not isinstance(value, Mapping):
        raise DataError(f"expected an object, got {type(value).__name__}", where=where)
    return value


def refuse_unknown(data: Mapping[str, Any], known: set[str], *, where: str) -> None:
    """Refuse an object with a field that is none of the known ones."""
    unknown = sorted(set(data) - known)
    if unknown:
        raise DataError(
            f"unknown field {unknown[0]!r}",
            where=where,
            fix=f"known are {', '.join(sorted(known))}",
        )


def as_index(value: Any, *, where: str) -> int:
    """Refuse what is not a whole number."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise DataError(f"{value!r} is not a whole number", where=where)
    if abs(value) > _LARGEST_INDEX:
        raise DataError("the number is too large", where=where)
    return value


def as_text(value: Any, *, where: str) -> str:
    """Refuse what is not a text, or is an empty one."""
    if not isinstance(value, str) or not value.strip():
        raise DataError(f"{value!r} is not a text", where=where)
    return value


def as_number(value: Any, *, where: str) -> float:
    """Refuse what is not a finite number."""
    return float(as_floats(value, name=where, shape=()))


def as_numbers(value: Any, length: int, *, where: str) -> tuple[float, ...]:
    """Refuse what is not a list of so many finite numbers."""
    return tuple(as_floats(value, name=where, shape=(length,)).tolist())


def as_path(value: Any, *, folder: Path, where: str) -> Path:
    """A path that the file writes relative to its folder."""
    if not isinstance(value, str) or not value:
        raise DataError(f"{value!r} is not a path", where=where)
    path = folder / value
    # Such that a path outside the folder is the one that was written, with no ".." in its midst.
    return path.resolve() if ".." in Path(value).parts else path


def written_path(path: Path, *, folder: Path | None) -> str:
    """A path as it is written into a file: relative to the folder that it is read relative to."""
    if folder is None:
        return str(path)
    for base in (folder, folder.resolve()):
        if path.is_relative_to(base):
            return path.relative_to(base).as_posix()
    there = path.resolve()
    try:
        return Path(os.path.relpath(there, folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return there.as_posix()
