"""A line that says that kernels are compiled, and how far it is."""

from __future__ import annotations

import sys
import time
from typing import Any

from numba.core import event
from numba.core.registry import CPUDispatcher

from cadalign.compile.decorators import KernelDispatcher


class CompileProgress(event.Listener):
    """A line on a terminal's or a notebook's standard error, written anew for every kernel.

    It tells how many of the kernels that the called one needs are compiled; those that are read
    from disk are not counted. Elsewhere, in a file for one, nothing is written.
    """

    def __init__(self) -> None:
        self._needed: set[Any] = set()
        self._total = self._depth = self._width = 0
        self._began = 0.0

    def on_start(self, event: Any) -> None:
        """Count what has to be compiled, if nothing was under way."""
        if not self._depth:
            self._needed = kernels_needed(event.data["dispatcher"])
            self._total, self._began = len(self._needed), time.perf_counter()
        self._depth += 1
        self._write()

    def on_end(self, event: Any) -> None:
        """Count one more; clear the line after the last."""
        self._depth -= 1
        self._needed.discard(event.data["dispatcher"].py_func)
        if self._depth:
            self._write()
        else:
            self._show("")

    def _write(self) -> None:
        done, seconds = self._total - len(self._needed), time.perf_counter() - self._began
        counted = f"{done} of {self._total}, {seconds:.0f} s"
        self._show(f"Compiling solvers, once for this version: {counted}")

    def _show(self, text: str) -> None:
        stream = sys.stderr
        if not (_is_notebook() or stream.isatty()):
            return
        stream.write(f"\r{text.ljust(self._width)}\r")
        stream.flush()
        self._width = len(text)


def kernels_needed(dispatcher: Any) -> set[Any]:
    """Functions of a kernel, and of all that it calls, that have no code in this process yet."""
    found: set[Any] = set()
    waiting = [dispatcher]
    while waiting:
        one = waiting.pop()
        new = isinstance(one, CPUDispatcher) and one.py_func not in found
        if new and not _is_compiled(one):
            found.add(one.py_func)
            names = one.py_func.__code__.co_names
            waiting.extend(one.py_func.__globals__.get(name) for name in names)
    return found


def _is_compiled(dispatcher: CPUDispatcher) -> bool:
    """True if there is code for Python or for other kernels."""
    part = dispatcher._part if isinstance(dispatcher, KernelDispatcher) else dispatcher
    return bool(dispatcher.overloads or part.overloads)


def _is_notebook() -> bool:
    return "ipykernel" in sys.modules
