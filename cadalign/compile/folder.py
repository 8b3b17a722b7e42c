"""Folder of compiled kernels, named by their sources and by Numba's version."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from functools import cache
from pathlib import Path

import numba
import platformdirs

_PACKAGE = Path(__file__).parents[1]
_SOURCES = (
    "solvers",
    "compile",
    "retrieval/kernels.py",
    "shapes/gaussians.py",
    "geometry/clipping.py",
)
"""Folders and files of all kernels, and of what compiles them."""
_UNUSED_DAYS = 60


def kernel_folder() -> Path:
    """Folder in $NUMBA_CACHE_DIR, the user's cache, or the package's own.

    The first that can be written to; in the user's cache if none can. Numba alone compiles a
    function anew when its own file changes, but not when one that it calls in another file does.
    """
    return cache_folder() / _version(_PACKAGE)


@cache
def _version(package: Path) -> str:
    content = hashlib.sha256(numba.__version__.encode())
    for name in _SOURCES:
        path = package / name
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            content.update(source.read_bytes())
    return content.hexdigest()[:16]


def cache_folder() -> Path:
    """Folder of the compiled kernels of all versions."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return Path(chosen)
    users = Path(platformdirs.user_cache_dir("cadalign", appauthor=False)) / "kernels"
    own = Path(__file__).parent / "__pycache__"
    return next((folder for folder in (users, own) if can_write(folder)), users)


def can_write(folder: Path) -> bool:
    """True if a folder, or the nearest above it that exists, can be written to."""
    existing = next((place for place in (folder, *folder.parents) if place.is_dir()), Path("/"))
    return os.access(existing, os.W_OK)


@cache
def remove_unused(folder: Path) -> None:
    """Remove folders of other versions that no process has written to for long."""
    oldest = time.time() - _UNUSED_DAYS * 86400
    for other in folder.parent.iterdir():
        if other != folder and other.is_dir() and other.stat().st_mtime < oldest:
            shutil.rmtree(other, ignore_errors=True)
