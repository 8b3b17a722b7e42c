"""Kernels whose parts are optimized once, in the kernel that Python calls, and kept on disk.

Left alone, Numba optimizes every function, and again as a part of each that calls it, at every
level: a first call takes three times as long. This module alone uses private names of Numba;
`cadalign.compile` does without it where one of them is missing.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import logging
import os
import pickle
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from llvmlite import binding
from numba.core import compiler, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.environment import Environment, lookup_environment
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from cadalign.compile.folder import kernel_folder, remove_unused

logger = logging.getLogger("cadalign")
_KIND = "part"


class KernelDispatcher(CPUDispatcher):
    """A function compiled for Python and, apart from that, for the kernels that call it."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=KernelCompiler)
        self._cache: Any = KernelCache(function, "kernel")

    @cached_property
    def _part(self) -> Any:
        compiler = FastPartCompiler if self.targetoptions["fastmath"] else PartCompiler
        bare = {**self.targetoptions, "no_cpython_wrapper": True}
        part: Any = CPUDispatcher(self.py_func, targetoptions=bare, pipeline_class=compiler)
        part._cache = KernelCache(self.py_func, _KIND)
        return part

    def get_call_template(self, arguments: Any, keywords: Any) -> Any:
        """Types of a call by a kernel; the number 3 takes the code of any integer."""
        named = {name: types.unliteral(kind) for name, kind in keywords.items()}
        return self._part.get_call_template(tuple(map(types.unliteral, arguments)), named)

    def get_overload(self, signature: Any) -> Any:
        return self._part.get_overload(signature)


class KernelLibrary(JITCodeLibrary):
    """Code that Python calls, without LLVM's slow and useless rewriting of addresses in loops."""

    def _finalize_final_module(self) -> None:
        binding.set_option("cadalign", "-disable-lsr=true")
        try:  # Numba's lock keeps other compilations out
            super()._finalize_final_module()
        finally:
            binding.set_option("cadalign", "-disable-lsr=false")


class PartLibrary(JITCodeLibrary):
    """Code that is linked into kernels: intermediate code, optimized there, without an address."""

    optimized = False

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Nothing: the kernel that the function ends up in is told its environment."""

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        return self.name, _KIND, self._get_module_for_linking().as_bitcode()

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, code = state
        if kind != _KIND:
            return JITCodeLibrary._unserialize(codegen, state)
        library = cls(codegen, name)
        library._final_module = library._shared_module = binding.parse_bitcode(code)
        library._finalized = True
        return library

    def _optimize_final_module(self) -> None:
        if self.optimized:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


class KernelCompiler(compiler.Compiler):
    """Compiler of a kernel that Python calls."""

    library: type[JITCodeLibrary] = KernelLibrary

    def compile_extra(self, function: Any) -> Any:
        """Compile a function; what it calls, Numba's own functions among it, becomes its parts."""
        codegen = self.state.targetctx.codegen()
        self.state.library = self.library(codegen, function.__qualname__)
        self.state.library.enable_object_caching()
        before, codegen._library_class = codegen._library_class, PartLibrary  # under Numba's lock
        try:
            return super().compile_extra(function)
        finally:
            codegen._library_class = before


class PartCompiler(KernelCompiler):
    """Compiler of what kernels call."""

    library = PartLibrary


class FastPartCompiler(KernelCompiler):
    """Compiler of what kernels call and may be reordered: that once, for the same bits in all."""

    library = type("FastPartLibrary", (PartLibrary,), {"optimized": True})


_folder = cache(kernel_folder)


class _Locator(_CacheLocator):
    """Places of the files of a source's kernels, by its content."""

    def __init__(self, function: Any, source: str) -> None:
        content = Path(source).read_bytes() if Path(source).is_file() else source.encode()
        self._hash = hashlib.sha256(content).hexdigest()

    def get_cache_path(self) -> str:
        return str(_folder())

    def get_source_stamp(self) -> str:
        return self._hash

    def get_disambiguator(self) -> str:
        return self._hash[:16]

    @classmethod
    def from_function(cls, function: Any, source: str) -> _Locator:
        return cls(function, source)


class _Code(CompileResultCacheImpl):
    """Compiled code with its checksum: what a power failure left of it might crash."""

    _locator_classes = [_Locator]  # noqa: RUF012

    def reduce(self, data: Any) -> tuple[bytes, bytes]:
        content = dumps(super().reduce(data))
        return hashlib.sha256(content).digest(), content

    def rebuild(self, target_context: Any, payload: tuple[bytes, bytes]) -> Any:
        checksum, content = payload
        if hashlib.sha256(content).digest() != checksum:
            raise ValueError("damaged")
        return super().rebuild(target_context, _CodeReader(io.BytesIO(content)).load())


class _CodeReader(pickle.Unpickler):
    """A reader that imports nothing: Numba imports the module of every function in the code."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """Constants of a compiled function; only code in object mode reads its module's variables."""
    found = lookup_environment(name)
    if found is None:
        found = Environment({"__name__": module})
        found.consts[:], found.env_name = constants, name
        Environment._memo[name] = found
    return found


class KernelCache(FunctionCache):
    """Compiled forms of one kernel; ``use`` tells code for Python from code for other kernels."""

    _impl_class = _Code

    def __init__(self, function: Any, use: str) -> None:
        super().__init__(function)
        self._use = use

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        types, *others = super()._index_key(signature, codegen)
        return repr(types), *others, self._use  # as text: classes would be imported

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code for a signature, None if there is none, or it is damaged."""
        rtsys.initialize(target_context)  # all that code calls; Numba would import its front end
        try:
            return self._load_overload(sig, target_context)
        except OSError:
            return None
        except Exception:  # whatever half a file makes pickle raise
            _tell_damaged(self._cache_path)
            Path(self._cache_file._index_path).unlink(missing_ok=True)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save code, one process at a time: each reads the index, and adds to it."""
        try:
            os.makedirs(self._cache_path, exist_ok=True)
            with open(Path(self._cache_path) / "lock", "a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                super().save_overload(sig, data)
            remove_unused(Path(self._cache_path))
        except OSError:  # every process compiles for itself, `cadalign doctor` says so
            return


@cache
def _tell_damaged(folder: str) -> None:
    """Warn once in a process, however many files there are."""
    logger.warning("%s: some of the compiled code is damaged; it is compiled anew", folder)
