"""Files of compiled kernels, found by the content of the sources they were compiled from.

All installations of a user share one folder: neither a new virtual environment, a fresh clone, nor
going back to an older version compiles anything that was compiled before.
"""

from __future__ import annotations

import os
import sys
import time
from functools import cache, cached_property
from itertools import count
from pathlib import Path
from typing import Any

import platformdirs
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    _CacheLocator,
)
from numba.core.runtime.nrt import rtsys

from cadalign.compile.loading import CodeFiles
from cadalign.compile.shipped import shipped_files
from cadalign.compile.sources import source_hash

_UNUSED_DAYS = 60


def kernel_folder() -> Path:
    """Folder of compiled kernels: $NUMBA_CACHE_DIR, the user's cache, or the package's own.

    The first that can be written to; the user's cache if none can.
    """
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


class _Locator(_CacheLocator):
    """Places of one kernel's files, named by its sources' hash."""

    def __init__(self, source: Path) -> None:
        self._hash = source_hash(source)

    @classmethod
    def from_function(cls, _: Any, source: str) -> _Locator:
        return cls(Path(source))

    def get_cache_path(self) -> str:
        return str(_folder())

    def get_source_stamp(self) -> str:
        return self._hash

    def get_disambiguator(self) -> str:
        return self._hash[:16]

    def ensure_cache_path(self) -> None:
        """Nothing yet: the folder is made when something is saved."""


class _Implementation(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # type: ignore[list-item]  # noqa: RUF012


class KernelCache(FunctionCache):
    """Compiled forms of one kernel, on disk.

    `use` tells code that Python calls from code that kernels call.
    """

    _impl_class = _Implementation

    def __init__(self, function: Any, use: str) -> None:
        super().__init__(function)
        self._use = use
        self._cache_file = KernelFiles(
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        # Types as text: an index that another version wrote must not ask for classes of that one.
        types, *others = super()._index_key(signature, codegen)
        return repr(types), *others, self._use, _sources_of(signature)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code for a signature, None if there is none.

        Numba first imports its whole front end, and SciPy's BLAS with it, which takes longer than a
        fit: reading code back only needs the runtime that the code calls. The compiler imports the
        rest itself.
        """
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)


def _sources_of(signature: Any) -> tuple[str, ...]:
    """Hashes of the modules of named tuples among a signature's types.

    Members of kernel families, which the code calls for such a type, stand there.
    """
    kinds = [getattr(kind, "instance_class", None) for kind in signature]
    modules = [sys.modules[kind.__module__].__file__ for kind in kinds if kind is not None]
    return tuple(source_hash(Path(file)) for file in modules if file is not None)


class KernelFiles(CodeFiles):
    """Index and code of one kernel; code that came with the installation is found, too."""

    def load(self, key: Any) -> Any:
        """Compiled code for a signature and a processor, None if there is none yet."""
        try:
            found = super().load(key)
        except OSError:  # a folder that cannot be read
            found = None
        return self._shipped.load(key) if found is None and self._shipped else found

    def save(self, key: Any, data: Any) -> None:
        """Save compiled code, one process at a time, before the index that names it.

        Numba writes the index first and without a lock: of processes that compile at the same time,
        one could read code of an older version, or that of another signature. Where nothing can be
        written, every process compiles for itself (`cadalign doctor` says so).
        """
        from filelock import FileLock

        try:
            os.makedirs(self._cache_path, exist_ok=True)
            with FileLock(f"{self._index_path}.lock"):
                names = self._load_index()
                taken = set(names.values())
                free = (self._data_name(number) for number in count(1))
                name = names.get(key) or next(name for name in free if name not in taken)
                self._save_data(name, data)
                self._save_index({**names, key: name})
            _remove_unused(Path(self._cache_path))
        except OSError:
            return

    @cached_property
    def _shipped(self) -> Any:
        return shipped_files(Path(self._index_name).stem, self._source_stamp)


@cache
def _folder() -> Path:
    return kernel_folder()


@cache
def _remove_unused(folder: Path) -> None:
    """Remove what no process has read or written for long, once in a process that compiles."""
    oldest = time.time() - _UNUSED_DAYS * 86400
    for path in folder.glob("*.nb[ic]*"):
        status = path.stat()
        if max(status.st_atime, status.st_mtime) < oldest:
            path.unlink(missing_ok=True)
