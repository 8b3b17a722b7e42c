"""Files of compiled kernels, found by the content of the sources they were compiled from.

All installations of a user share one folder: neither a new virtual environment, a fresh clone, nor
going back to an older version compiles anything that was compiled before.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import logging
import os
import pickle
import re
import sys
import time
from collections.abc import Iterator
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import platformdirs
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    _CacheLocator,
)
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime.nrt import rtsys

_PACKAGE = Path(__file__).parents[1]
# What compiles, and what the files of code are like.
_COMPILERS = tuple(Path(__file__).parent / name for name in ("__init__.py", "files.py"))

# Imports at the left margin: what stands further right is for type checking or imported when
# called, and no kernel can use it. Parsing properly would take longer than reading the code.
_IMPORT = re.compile(
    r"^from (cadalign[\w.]*) import (\([^)]*\)|[^\n(]*)|^import (cadalign[\w.]*)", re.M
)
logger = logging.getLogger("cadalign")
_CHECKSUM_BYTES = 16
_UNUSED_DAYS = 60


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
    except OSError:  # of code without a file, only its own name distinguishes it
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


class KernelFiles(IndexDataCacheFile):
    """Index and code of one kernel; reading them imports nothing that only compiling needs."""

    def load(self, key: Any) -> Any:
        """Compiled code for a signature and a processor, None if there is none yet."""
        try:
            return super().load(key)
        except OSError:  # a folder that cannot be read
            return None

    def save(self, key: Any, data: Any) -> None:
        """Save compiled code, one process at a time, before the index that names it.

        Numba writes the index first and without a lock: of processes that compile at the same time,
        one could read code of an older version, or that of another signature. Where nothing can be
        written, every process compiles for itself (`cadalign doctor` says so).
        """
        try:
            os.makedirs(self._cache_path, exist_ok=True)
            with open(f"{self._index_path}.lock", "a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                names = self._load_index()
                taken = set(names.values())
                free = (self._data_name(number) for number in count(1))
                name = names.get(key) or next(name for name in free if name not in taken)
                self._save_data(name, data)
                self._save_index({**names, key: name})
            _remove_unused(Path(self._cache_path))
        except OSError:
            return

    def _load_index(self) -> dict[Any, str]:
        """Names of the files of code by signature and processor."""
        content = _read_whole(self._index_path)
        if content is None:
            return {}
        stream = io.BytesIO(content)
        if pickle.load(stream) != self._version:  # what follows may be of classes of that version
            return {}
        stamp, names = pickle.load(stream)
        return dict(names) if stamp == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        content = pickle.dumps(self._version) + self._dump((self._source_stamp, overloads))
        self._write(self._index_path, content)

    def _load_data(self, name: str) -> Any:
        content = _read_whole(self._data_path(name))
        return None if content is None else _CodeReader(io.BytesIO(content)).load()

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), self._dump(data))

    def _write(self, path: str, content: bytes) -> None:
        with self._open_for_write(path) as file:
            file.write(_checksum(content) + content)


def _read_whole(path: str) -> bytes | None:
    """Content of a file of compiled code; None where there is none, or it is damaged."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        return None
    checksum, content = data[:_CHECKSUM_BYTES], data[_CHECKSUM_BYTES:]
    if checksum == _checksum(content):
        return content
    _tell_damaged(str(Path(path).parent))
    return None


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECKSUM_BYTES).digest()


@cache
def _tell_damaged(folder: str) -> None:
    """Warn once in a process, however many files there are."""
    logger.warning("%s: some of the compiled code is damaged; it is compiled anew", folder)


class _CodeReader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """Constants of a compiled function, with the variables of its module if that is imported.

    Numba imports the module of every function that was compiled into the code, its own and SciPy's
    for the most part. Only code in object mode reads these variables; kernels have none.
    """
    known = lookup_environment(name)
    if known is not None:
        return known
    imported = sys.modules.get(module)
    found = Environment({"__name__": module} if imported is None else vars(imported))
    found.consts[:] = constants
    found.env_name = name
    Environment._memo[name] = found
    return found


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

    `use` distinguishes code that Python calls from code that kernels call.
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
    """Hashes of the modules of named tuples among a signature's types, and among their fields'.

    Members of kernel families, which the code calls for such a type, stand there.
    """
    waiting, found = list(signature), set[str]()
    while waiting:
        kind = waiting.pop()
        waiting.extend(getattr(kind, "types", ()))
        named = getattr(kind, "instance_class", None)
        file = None if named is None else sys.modules[named.__module__].__file__
        if file is not None:
            found.add(source_hash(Path(file)))
    return tuple(sorted(found))


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
