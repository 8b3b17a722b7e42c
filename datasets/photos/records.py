"""Records of large JSON files and tables, each parsed when it is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from msgspec import Raw

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, brief
from cadalign.io.documents import convert, in_file
from cadalign.io.files import damaged, read_bytes, read_text

T = TypeVar("T")


def read_list(path: Path) -> list[Raw]:
    """Read a JSON file that holds a list, its entries not yet parsed.

    Raises
    ------
    DataError
        If it cannot be read, is no valid JSON (cut short, say), or holds no list.
    """
    return list(_read_raw(path, list[Raw], "a list"))


def read_table(path: Path) -> dict[str, Raw]:
    """Read a JSON file that holds an object, its values not yet parsed.

    Raises
    ------
    DataError
        If it cannot be read, is no valid JSON (cut short, say), or holds no object.
    """
    return dict(_read_raw(path, dict[str, Raw], "an object"))


def parse(raw: Raw, kind: type[T] | Any, *, path: Path, where: str) -> T | Any:
    """Parse an entry as a declared type; errors name the file and the place in it.

    Raises
    ------
    DataError
        If it is not of this type, or no valid JSON.
    """
    try:
        data = msgspec.json.decode(raw)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise DataError(f"not valid JSON: {brief(error)}", where=f"{path}: {where}") from None
    except RecursionError:
        raise DataError("nested too deeply", where=f"{path}: {where}") from None
    with in_file(path):
        return convert(data, kind, where)


def read_matrix(path: Path, shape: tuple[int, int]) -> FloatArray:
    """Read a text file of a matrix, a row on each line.

    Raises
    ------
    DataError
        If it cannot be read, or is not a matrix of finite numbers of this shape.
    """
    text = read_text(path)
    rows = [line.split() for line in text.splitlines() if line.strip()]
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:
        raise damaged("not a table of numbers", path) from None
    if matrix.shape != shape:
        raise damaged(f"shape {matrix.shape}, expected {shape}", path)
    if not np.isfinite(matrix).all():
        raise DataError("some of its numbers are not finite", where=str(path))
    return matrix


def _read_raw(path: Path, kind: Any, name: str) -> Any:
    data = read_bytes(path)
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.ValidationError:
        raise DataError(f"expected {name}", where=str(path)) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise damaged(f"not valid JSON: {brief(error)}", path) from None
    except RecursionError:
        raise DataError("not valid JSON: nested too deeply", where=str(path)) from None
