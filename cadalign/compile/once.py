"""Dispatcher and disk cache that let LLVM optimize each kernel only once.

By default Numba optimizes a function alone and again within each of its callers, which makes a
first call three times as slow. Here a function that kernels call stays unoptimized until it is
linked into the kernel that Python calls. Only this module uses private names of Numba. If one is
missing, `cadalign.compile` uses Numba's own dispatcher.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import sys
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from llvmlite import binding
from numba.core import compiler, types
from numba.core.codegen import JITCodeLibrary
from numba.core.environment import Environment, lookup_environment
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from cadalign.compile.folder import kernel_folder

_KIND = "part"
_DIGITS = 20  # of the hash in a file name
_CHECKSUM = hashlib.sha256().digest_size


class KernelDispatcher(CPUDispatcher):
    """Compiles a function twice: for calls from Python, and as a part of other kernels."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=KernelCompiler)
        self._cache: Any = KernelCache(function, "kernel")

    @cached_property
    def _part(self) -> Any:
        bare = {**self.targetoptions, "no_cpython_wrapper": True}
        part: Any = CPUDispatcher(self.py_func, targetoptions=bare, pipeline_class=KernelCompiler)
        part._cache = KernelCache(self.py_func, _KIND)
        return part

    def get_call_template(self, arguments: Any, keywords: Any) -> Any:
        """Resolve a call from a kernel; literal types are widened, so 3 shares the integer code."""
        named = {name: types.unliteral(kind) for name, kind in keywords.items()}
        return self._part.get_call_template(tuple(map(types.unliteral, arguments)), named)

    def get_overload(self, signature: Any) -> Any:
        return self._part.get_overload(signature)


class KernelLibrary(JITCodeLibrary):
    """Code that Python calls, without LLVM's loop strength reduction: slow and no gain here."""

    def _finalize_final_module(self) -> None:
        binding.set_option("cadalign", "-disable-lsr=true")
        try:  # Numba's lock excludes other compilations
            super()._finalize_final_module()
        finally:
            binding.set_option("cadalign", "-disable-lsr=false")


class PartLibrary(JITCodeLibrary):
    """Intermediate code that is linked into kernels and optimized there; it has no address."""

    is_optimized = False  # True for code with reordered sums: all its callers get the same bits

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: the kernel that includes this code sets its environment."""

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
        if self.is_optimized:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


@cache
def announce_compiling() -> None:
    """Announce the compilation on a terminal or in a notebook, once per process."""
    if sys.stderr.isatty() or "ipykernel" in sys.modules:
        sys.stderr.write("Compiling cadalign's solvers (once per version, up to a minute)\n")
        sys.stderr.flush()


class KernelCompiler(compiler.Compiler):
    """Compiler of a kernel for Python, or of a part of other kernels."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function; the functions that it calls, also Numba's own, become parts."""
        announce_compiling()
        codegen = self.state.targetctx.codegen()
        is_part, is_fast = self.state.flags.no_cpython_wrapper, bool(self.state.flags.fastmath)
        library = PartLibrary if is_part else KernelLibrary
        self.state.library = library(codegen, function.__qualname__)
        self.state.library.is_optimized = is_fast
        self.state.library.enable_object_caching()
        before, codegen._library_class = codegen._library_class, PartLibrary  # under Numba's lock
        try:
            return super().compile_extra(function)
        finally:
            codegen._library_class = before


class _CodeReader(pickle.Unpickler):
    """Unpickler that does not import the modules of compiled functions, as Numba's would."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """Environment with a function's constants; only object mode needs the module's variables."""
    found = lookup_environment(name)
    if found is None:
        found = Environment({"__name__": module})
        found.consts[:], found.env_name = constants, name
        Environment._memo[name] = found
    return found


class KernelCache:
    """Disk cache of one kernel, with one file per signature and use.

    A file begins with a checksum, because damaged code could crash the process.
    """

    def __init__(self, function: Any, use: str) -> None:
        self._name = f"{function.__module__}.{function.__name__}"
        self._location = function.__code__.co_firstlineno, use
        self.cache_path = str(kernel_folder())

    def _file(self, signature: Any, codegen: Any) -> Path:
        form = repr((self._name, self._location, signature, codegen.magic_tuple()))
        code = hashlib.sha256(form.encode()).hexdigest()[:_DIGITS]
        return Path(self.cache_path) / f"{self._name}-{code}.nbc"

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Load the code for a signature; None if it is missing or damaged."""
        rtsys.initialize(target_context)  # enough to run code, without importing Numba's front end
        try:
            content = self._file(signature, target_context.codegen()).read_bytes()
        except OSError:
            return None
        checksum, content = content[:_CHECKSUM], content[_CHECKSUM:]
        if hashlib.sha256(content).digest() != checksum:
            return None
        parts = _CodeReader(io.BytesIO(content)).load()
        return compiler.CompileResult._rebuild(target_context, *parts)

    def save_overload(self, signature: Any, found: Any) -> None:
        """Save code; without write access every process compiles for itself."""
        content = dumps(found._reduce())
        file = self._file(signature, found.codegen)
        written = file.with_suffix(f".{os.getpid()}")
        with suppress(OSError):  # `cadalign doctor` reports it
            file.parent.mkdir(parents=True, exist_ok=True)
            written.write_bytes(hashlib.sha256(content).digest() + content)
            written.replace(file)
