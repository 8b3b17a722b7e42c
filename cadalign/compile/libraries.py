"""Libraries of code that is optimized once, in the kernel that Python calls.

Left alone, Numba optimizes every function, makes it executable, and does both again as a part of
each function that calls it, at every level. Here, what kernels call is kept as intermediate code
and optimized where it ends up: in a kernel that Python calls.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import binding
from numba.core import compiler
from numba.core.codegen import JITCodeLibrary

_KIND = "part"


class PartLibrary(JITCodeLibrary):
    """Code that is linked into kernels, and has no address of its own."""

    optimized = False

    @property
    def codegen(self) -> Any:
        """The library itself, as what is told the environments of its functions."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Nothing: the kernel that the function ends up in is told."""

    def get_pointer_to_function(self, name: str) -> int:
        """No address."""
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """The intermediate code; there is no other."""
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

    library: type[JITCodeLibrary] = JITCodeLibrary

    def compile_extra(self, function: Any) -> Any:
        """Compile a function; what it calls, Numba's own functions among it, becomes its parts."""
        codegen = self.state.targetctx.codegen()
        self.state.library = self.library(codegen, function.__qualname__)
        self.state.library.enable_object_caching()
        with parts_in(codegen):
            return super().compile_extra(function)


class PartCompiler(KernelCompiler):
    """Compiler of what kernels call."""

    library = PartLibrary


class FastPartCompiler(KernelCompiler):
    """Compiler of what kernels call and may be reordered: that once, for the same bits in all."""

    library = type("FastPartLibrary", (PartLibrary,), {"optimized": True})


@contextmanager
def parts_in(codegen: Any) -> Iterator[None]:
    """Let all that Numba compiles or reads from disk meanwhile become parts.

    Numba's lock around compiling keeps other threads out.
    """
    before = codegen._library_class
    codegen._library_class = PartLibrary
    try:
        yield
    finally:
        codegen._library_class = before
