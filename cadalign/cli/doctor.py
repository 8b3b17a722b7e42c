"""`cadalign doctor`: check this machine, and compile ahead for it."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

from cadalign.cli.common import JsonOption, answer, print_json, waiting
from cadalign.errors import InputError


@dataclass(frozen=True)
class Doctor(JsonOption):
    """Check the renderers, and show how to enable missing ones.

    Also shows the processor cores and the cache of compiled solvers. With --compile, compiles the
    solvers ahead.
    """

    compile: bool = False
    """Compile all solvers now, as for a Docker image, in place of when they are first called."""

    def run(self) -> int:
        """Run the checks; returns the exit code, 0 if ray casting works."""
        if self.compile:
            return self._compile()
        with waiting("trying the renderers, each in a process of its own ..."):
            health = examine()
        if self.json:
            print_json(health)
        else:
            _print(health)
        return 0 if health["renderers"][-1]["works"] else 1

    def _compile(self) -> int:
        from cadalign.cli.compile_ahead import compile_ahead

        require_cache()
        began = time.perf_counter()
        with waiting("compiling ...") as show:
            compile_ahead(progress=lambda text: show(f"compiled: {text} ..."))
        found = {"seconds": round(time.perf_counter() - began, 1), "cache": compiled_cache()}
        if self.json:
            print_json(found)
        else:
            answer(f"Compiled in {found['seconds']} s: {found['cache']}")
        return 0


def _print(health: dict[str, Any]) -> None:
    for each in health["renderers"]:
        answer(f"{each['name']:9} {'works' if each['works'] else 'fails'}: {each['detail']}")
    answer(f"--renderer auto takes: {health['best']}")
    for name, command in health["remedies"].items():
        answer(f"To enable {name}: {command}")
    answer(f"Python {health['python']}, NumPy {health['numpy']}, Numba {health['numba']}")
    answer(f"Cores: {health['cores']}, of which this process may use {health['usable_cores']}")
    answer(f"Compiled solvers: {health['cache']}")


def examine() -> dict[str, Any]:
    """Try every renderer in a process of its own and collect the rest; takes some seconds.

    ``renderers`` are all of them, ray casting last; ``best`` is what "auto" selects, ``remedies``
    are the commands that would enable what does not work.
    """
    from cadalign.render.probe import REMEDIES, RENDERERS, best_renderer, probe_renderer

    renderers = [asdict(probe_renderer(name)) for name in RENDERERS]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    names = [each["name"] for each in renderers if not each["works"]]
    return {
        "renderers": renderers,
        "best": best_renderer(),
        "remedies": {name: REMEDIES[name] for name in names},
        "cores": os.cpu_count() or 1,
        "usable_cores": usable or 1,
        "cache": compiled_cache(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "numba")},
    }


def compiled_cache() -> str:
    """Describe the cache of compiled solvers: its folder, and how many functions it holds."""
    from cadalign.compile.folder import can_write, kernel_folder

    folder = kernel_folder()
    count = sum(1 for _ in folder.rglob("*.nbc")) if folder.is_dir() else 0
    if count:
        return f"{count} functions kept in {folder}"
    if can_write(folder):
        return f"none yet; they will be kept in {folder}"
    fix = "set NUMBA_CACHE_DIR, or every process compiles anew"
    return f"{folder} cannot be written to; {fix}"


def require_cache() -> None:
    """Refuse to compile ahead where nothing of it could be kept."""
    from cadalign.compile.folder import can_write, kernel_folder

    folder = kernel_folder()
    if not can_write(folder):
        fix = "set NUMBA_CACHE_DIR to a folder that can be"
        raise InputError(f"{folder} cannot be written to", where="--compile", fix=fix)
