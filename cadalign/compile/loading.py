"""Compiled code on disk, read back without importing Numba's compiler, and only if it is whole.

A file that a power failure left empty or in part, or a disk damaged, counts as none: the code is
compiled anew and the file written over. Every file begins with the checksum of what follows.
"""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
import sys
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile
from numba.core.environment import Environment, lookup_environment

logger = logging.getLogger("cadalign")

_CHECKSUM_BYTES = 16


class CodeFiles(IndexDataCacheFile):
    """Index and code of one kernel; reading them imports nothing that only compiling needs."""

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
