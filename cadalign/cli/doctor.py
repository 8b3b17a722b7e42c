"""`cadalign doctor`: check this machine, and compile ahead for it."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.cli.common import answer, waiting
from cadalign.errors import InputError

if TYPE_CHECKING:
    from cadalign.render.probe import Probe


@dataclass(frozen=True)
class Doctor:
    """Check the renderers, and show how to enable missing ones.

    Also shows the processor cores and the cache of compiled solvers. With --compile, compiles the
    solvers ahead.
    """

    compile: bool = False
    """Compile all solvers now, as for a Docker image, in place of when they are first called."""

    def run(self) -> int:
        """Run the checks; returns the exit code, 0 if ray casting works."""
        return self._compile() if self.compile else self._check()

    def _check(self) -> int:
        from cadalign.render.probe import REMEDIES, best_renderer

        with waiting("trying the renderers, each in a process of its own ..."):
            renderers = probed_renderers()
        for each in renderers:
            answer(f"{each.name:9} {'works' if each.works else 'fails'}: {each.detail}")
        answer(f"--renderer auto takes: {best_renderer()}")
        for each in renderers:
            if not each.works:
                answer(f"To enable {each.name}: {REMEDIES[each.name]}")
        versions = (f"{name} {version(name.lower())}" for name in ("NumPy", "Numba"))
        answer(f"Python {platform.python_version()}, {', '.join(versions)}")
        cores = os.cpu_count() or 1
        has_affinity = hasattr(os, "sched_getaffinity")  # not on macOS
        usable = len(os.sched_getaffinity(0)) if has_affinity else cores
        answer(f"Cores: {cores}, of which this process may use {usable}")
        answer(f"Compiled solvers: {compiled_cache()}")
        return 0 if renderers[-1].works else 1

    def _compile(self) -> int:
        from cadalign.cli.compile_ahead import compile_ahead
        from cadalign.compile.folder import kernel_folder

        folder = kernel_folder()
        if not can_write(folder):
            fix = "set NUMBA_CACHE_DIR to a folder that can be"
            raise InputError(f"{folder} cannot be written to", where="--compile", fix=fix)
        began = time.perf_counter()
        with waiting("compiling ..."):
            compile_ahead()
        answer(f"Compiled in {time.perf_counter() - began:.1f} s: {compiled_cache()}")
        return 0


def probed_renderers() -> list[Probe]:
    """Try every renderer in a process of its own, ray casting last; takes some seconds."""
    from cadalign.render.probe import RENDERERS, probe_renderer

    return [probe_renderer(name) for name in RENDERERS]


def can_write(folder: Path) -> bool:
    """True if a folder, or the nearest above it that exists, can be written to."""
    existing = next((place for place in (folder, *folder.parents) if place.is_dir()), Path("/"))
    return os.access(existing, os.W_OK)


def compiled_cache() -> str:
    """Describe the cache of compiled solvers: its folder, and how many functions it holds."""
    from cadalign.compile.folder import kernel_folder

    folder = kernel_folder()
    count = sum(1 for _ in folder.rglob("*.nbc")) if folder.is_dir() else 0
    if count:
        return f"{count} functions kept in {folder}"
    if can_write(folder):
        return f"none yet; they will be kept in {folder}"
    fix = "set NUMBA_CACHE_DIR, or every process compiles anew"
    return f"{folder} cannot be written to; {fix}"
