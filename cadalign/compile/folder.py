"""Cache folder of compiled kernels."""

from __future__ import annotations

import hashlib
import os
import sys
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
"""Folders and files with kernels, and the compiler."""


def kernel_folder() -> Path:
    """Folder in $NUMBA_CACHE_DIR or in the user's cache, named by a hash of sources and versions.

    A change of any source gives a new folder. Numba's own cache misses a change in another file
    that a function calls.
    """
    users = Path(platformdirs.user_cache_dir("cadalign", appauthor=False), "kernels")
    return Path(os.environ.get("NUMBA_CACHE_DIR") or users) / _version(_PACKAGE)


@cache
def _version(package: Path) -> str:
    python = f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"
    content = hashlib.sha256(f"{numba.__version__} {python}".encode())
    for name in _SOURCES:
        path = package / name
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            content.update(source.read_bytes())
    return content.hexdigest()[:16]
