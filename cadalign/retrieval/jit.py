"""How retrieval's kernels are compiled: as the solvers' are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from cadalign.solvers import jit

F = TypeVar("F", bound=Callable[..., Any])


def _stamp() -> tuple[float, int]:
    """A value that changes with any source file of this folder: newest time, total size."""
    stats = [path.stat() for path in Path(__file__).parent.glob("*.py")]
    return max(stat.st_mtime for stat in stats), sum(stat.st_size for stat in stats)


_STAMP = _stamp()


def kernel(function: F) -> F:
    """Like the solvers' `kernel`, and compiled anew when a file of this folder changes, too."""
    dispatcher: Any = jit.kernel(function)
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None:
        cache_file._source_stamp = (*cache_file._source_stamp, *_STAMP)
    return cast(F, dispatcher)
