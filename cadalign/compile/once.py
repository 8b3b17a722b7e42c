"""Kernels whose parts are optimized once, in the kernel that Python calls, and kept on disk.

Left alone, Numba optimizes every function, and again as a part of each that calls it, at every
level: a first call takes three times as long. This module alone uses private names of Numba;
`cadalign.compile` does without it where one of them is missing.
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
_DIGITS = 20  # of the code that names a form
_CHECKSUM = hashlib.sha256().digest_size


class KernelDispatcher(CPUDispatcher):
    """A function compiled for Python and, apart from that, for the kernels that call it."""

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

    is_optimized = False  # what may be reordered is, by itself: that once, for the same bits in all

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
        if self.is_optimized:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


@cache
def tell_compiling() -> None:
    """Say on a terminal or in a notebook, once in a process, that compiling takes its time."""
    if sys.stderr.isatty() or "ipykernel" in sys.modules:
        told = "Compiling cadalign's solvers, once for this version: this takes up to a minute\n"
        sys.stderr.write(told)
        sys.stderr.flush()


class KernelCompiler(compiler.Compiler):
    """Compiler of a kernel that Python calls, or of one that other kernels call."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function; what it calls, Numba's own functions among it, becomes its parts."""
        tell_compiling()
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


class KernelCache:
    """Compiled forms of one kernel, a file each, of code for Python or for other kernels.

    A file begins with its checksum: what a power failure left of it might crash.
    """

    def __init__(self, function: Any, use: str) -> None:
        self._name = f"{function.__module__}.{function.__name__}"
        self._place = function.__code__.co_firstlineno, use
        self.cache_path = str(kernel_folder())

    def _file(self, signature: Any, codegen: Any) -> Path:
        form = repr((self._name, self._place, signature, codegen.magic_tuple()))
        code = hashlib.sha256(form.encode()).hexdigest()[:_DIGITS]
        return Path(self.cache_path) / f"{self._name}-{code}.nbc"

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Compiled code for a signature; None if there is none, or it is damaged."""
        rtsys.initialize(target_context)  # all that code calls; Numba would import its front end
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
        """Save code; where that is not possible every process compiles for itself."""
        content = dumps(found._reduce())
        file = self._file(signature, found.codegen)
        written = file.with_suffix(f".{os.getpid()}")
        with suppress(OSError):  # `cadalign doctor` says so
            file.parent.mkdir(parents=True, exist_ok=True)
            written.write_bytes(hashlib.sha256(content).digest() + content)
            written.replace(file)
