"""Compile kernels; nothing else in cadalign calls Numba's compiler."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from itertools import count
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_SOLVERS = Path(__file__).parent / "solvers"


def kernel(function: F) -> F:
    """Compile on first use, keep the result on disk, release the interpreter lock while running.

    Floating-point operations keep their order and rounding: contraction into fused multiply-adds,
    for one, differs between code just compiled and code read back from disk, and results must be
    the same bit for bit.
    """
    return _compiled(function, set())


def fast_sums(function: F) -> F:
    """Like `kernel`, but sums may be reordered, so that they run on vector units."""
    return _compiled(function, {"reassoc"})


def inlined(function: F) -> F:
    """Like `kernel`, for a small function that is always compiled into its callers."""
    return _compiled(function, set(), forceinline=True)


def _compiled(function: F, fastmath: set[str], *, forceinline: bool = False) -> F:
    dispatcher = numba.njit(
        cache=True,
        nogil=True,
        error_model="numpy",
        fastmath=fastmath or False,
        boundscheck=False,
        forceinline=forceinline,
    )(function)
    # Numba recompiles a function when its own file changes, but not when a function that it calls
    # in another file does. One stamp for the files of its folder and of the solvers corrects that.
    cache_file: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None:
        folder = Path(function.__code__.co_filename).resolve().parent
        cache_file._source_stamp = _stamp(folder) + _stamp(_SOLVERS.resolve())
        cache_file.save = partial(_save, cache_file)
    return cast(F, dispatcher)


def _save(cache_file: Any, key: object, code: object) -> None:
    """Save compiled code, one process at a time, before the index that names it.

    Numba writes the index first and without a lock: of processes that compile at the same time,
    one could read code of an older version, or that of another signature.
    """
    from filelock import FileLock

    with FileLock(f"{cache_file._index_path}.lock"):
        names = cache_file._load_index()
        taken = set(names.values())
        free = (cache_file._data_name(number) for number in count(1))
        name = names.get(key) or next(name for name in free if name not in taken)
        cache_file._save_data(name, code)
        cache_file._save_index({**names, key: name})


@cache
def _stamp(folder: Path) -> tuple[float, int]:
    """Newest time and total size of a folder's source files; changes with any of them."""
    stats = [path.stat() for path in folder.glob("*.py")]
    return max(stat.st_mtime for stat in stats), sum(stat.st_size for stat in stats)
