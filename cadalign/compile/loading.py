"""Read compiled code back from disk without importing Numba's compiler."""

from __future__ import annotations

import io
import pickle
import sys
from typing import Any

from numba.core.caching import IndexDataCacheFile
from numba.core.environment import Environment, lookup_environment


class CodeFiles(IndexDataCacheFile):
    """Index and code of one kernel; reading them imports nothing that only compiling needs."""

    def _load_data(self, name: str) -> Any:
        with open(self._data_path(name), "rb") as file:
            return _CodeReader(io.BytesIO(file.read())).load()


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
