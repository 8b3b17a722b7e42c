"""Renderers, cores, the cache of compiled solvers, and data sets, as found on this machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from cadalign.compile.files import SHIPPED, can_write, kernel_folder, usable_target
from cadalign.datasets import PhotoSummary, open_photos
from cadalign.errors import InputError
from cadalign.render.probe import RENDERERS, Probe, best_renderer, probe_renderer, remedy


@dataclass(frozen=True)
class Health:
    """Findings of `examine`."""

    renderers: tuple[Probe, ...]
    """All of them, ray casting last."""
    best: str
    """The renderer that "auto" selects."""
    remedies: dict[str, str]
    """For each renderer that does not work, the command that would enable it."""
    cores: int
    usable_cores: int
    """Those that this process may use."""
    cache: str
    """Location and state of the cache of compiled solvers."""
    python: str
    numpy: str
    numba: str


def examine() -> Health:
    """Try every renderer in a process of its own and collect the rest; takes some seconds."""
    renderers = tuple(probe_renderer(name, timed=True) for name in RENDERERS)
    return Health(
        renderers=renderers,
        best=best_renderer(),
        remedies={found.name: command for found in renderers if (command := remedy(found))},
        cores=os.cpu_count() or 1,
        usable_cores=_usable_cores(),
        cache=compiled_cache(),
        python=platform.python_version(),
        numpy=version("numpy"),
        numba=version("numba"),
    )


def examine_data(folder: Path, *, progress: Callable[[int], object] | None = None) -> PhotoSummary:
    """Recognise the data set of photos in a folder and count what can be read.

    Parameters
    ----------
    folder : Path
    progress : callable, optional
        Called with the number of photos read after each.

    Raises
    ------
    DataError
        If no known data set is there, or it cannot be opened.
    """
    return open_photos(folder).summary(progress=progress)


def compiled_cache() -> str:
    """Describe the cache of compiled solvers: its folder, and how many functions it holds."""
    folder = kernel_folder()
    count = sum(1 for _ in folder.rglob("*.nbi")) if folder.is_dir() else 0
    shipped = sum(1 for _ in SHIPPED.glob("*.nbi")) if usable_target(SHIPPED) else 0
    came = f"{shipped} functions came with the installation; " if shipped else ""
    if count:
        return f"{came}{count} functions kept in {folder}"
    if can_write(folder):
        return f"{came}none yet; they will be kept in {folder}"
    fix = "set NUMBA_CACHE_DIR, or every process compiles anew"
    return f"{came}{folder} cannot be written to; {fix}"


def require_cache() -> None:
    """Refuse to compile ahead where nothing of it could be kept."""
    folder = kernel_folder()
    if not can_write(folder):
        fix = "set NUMBA_CACHE_DIR to a folder that can be"
        raise InputError(f"{folder} cannot be written to", where="--compile", fix=fix)


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
