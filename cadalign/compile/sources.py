"""Hash of the sources that a kernel is compiled from."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
# What compiles, and what the files of code are like.
_COMPILERS = tuple(
    Path(__file__).parent / name for name in ("decorators.py", "libraries.py", "loading.py")
)

# Imports at the left margin: what stands further right is for type checking or imported when
# called, and no kernel can use it. Parsing properly would take longer than reading the code.
_IMPORT = re.compile(
    r"^from (cadalign[\w.]*) import (\([^)]*\)|[^\n(]*)|^import (cadalign[\w.]*)", re.M
)


@cache
def source_hash(source: Path) -> str:
    """Hash of a file and of all of cadalign that it imports, directly or not.

    Numba alone recompiles a function when its own file changes, but not when a function that it
    calls in another file does. The rest of this package has no influence on the code.
    """
    found: dict[Path, bytes] = {}
    waiting = [source, *_COMPILERS]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found[path], imported = _content(path)
            waiting.extend(imported)
    contents = sorted(found.values())
    return hashlib.sha256(b"".join(contents)).hexdigest()


@cache
def _content(path: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Hash of one file, and the files of the modules that it imports."""
    try:
        code = path.read_bytes()
    except OSError:  # of code without a file, only its own name tells it apart
        return str(path).encode(), ()
    text = code.decode(errors="replace")
    return hashlib.sha256(code).digest(), tuple(dict.fromkeys(_imported(text)))


def _imported(text: str) -> Iterator[Path]:
    for origin, names, module in _IMPORT.findall(text):
        if module:
            yield from _file_of(module)
            continue
        yield from _file_of(origin)
        for name in re.findall(r"\w+", names):
            yield from _file_of(f"{origin}.{name}")


def _file_of(module: str) -> Iterator[Path]:
    """The file of a module of cadalign; none for a function's name, or a module of this package."""
    if module.startswith(__package__):
        return
    place = _PACKAGE.joinpath(*module.split(".")[1:])
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.is_file():
            yield path
