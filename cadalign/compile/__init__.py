"""Compile kernels, keep their code on disk, and say so while it takes its time.

Nothing else in cadalign calls Numba's compiler.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, TypeVar, cast

from llvmlite import binding
from numba import literal_unroll
from numba.core import compiler, config, event, types
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import CPUDispatcher

from cadalign.compile.files import KernelCache

__all__ = ["KernelFamily", "borrowing", "fast_sums", "inlined", "kernel", "unrolled"]

unrolled = literal_unroll
"""Loop over a tuple of several types; the body is compiled for each."""

F = TypeVar("F", bound=Callable[..., Any])


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
    """Like `borrowing`, for a small function that is always compiled into its callers."""
    return _compiled(function, set(), forceinline=True, counts=False)


def borrowing(function: F) -> F:
    """Like `kernel`, for a function that makes no arrays and returns none.

    It works on arrays of its callers, and does not count its references to them: Numba counts by
    atomic operations, a hundred of which take as long as an iteration with ten keypoints.
    """
    return _compiled(function, set(), counts=False)


def _compiled(
    function: F, fastmath: set[str], *, forceinline: bool = False, counts: bool = True
) -> F:
    if getattr(config, "DISABLE_JIT", False):  # Numba's types do not know it
        return function
    options = {
        "nopython": True,
        "nogil": True,
        "error_model": "numpy",
        "fastmath": fastmath or False,
        "boundscheck": False,
        "forceinline": forceinline,
        "_nrt": counts,
        "no_cfunc_wrapper": True,
    }
    return cast(F, KernelDispatcher(function, options))


class KernelFamily:
    """A kernel of one name with a member for each type of its first argument.

    What calls it is compiled once for each of these types, with the member of that type in it.
    Members stand in the module of their type, or in one that this module imports: code that was
    compiled for a type is found by the sources of its module.
    """

    def __init__(self, name: str) -> None:
        self.__name__ = name
        self._members: dict[type, Any] = {}

    def of(self, kind: type) -> Callable[[F], F]:
        """Decorate the kernel that is the member for a type of NamedTuple."""

        def add(member: F) -> F:
            self._members[kind] = member
            return member

        return add

    is_compiling = False  # members know it of themselves

    def __call__(self, first: Any, *others: Any) -> Any:
        return self._members[type(first)](first, *others)

    @property
    def _numba_type_(self) -> types.Dispatcher:
        return types.Dispatcher(cast(Any, self))

    def get_call_template(self, arguments: Any, keywords: Any) -> Any:
        """Types of a call by a kernel."""
        return self._member(arguments).get_call_template(arguments, keywords)

    def get_overload(self, signature: Any) -> Any:
        """Code that a kernel calls."""
        return self._member(signature).get_overload(signature)

    def _member(self, arguments: Any) -> Any:
        kind = arguments[0].instance_class
        if kind not in self._members:
            raise TypeError(f"{self.__name__} has no member for {kind.__name__}")
        return self._members[kind]


class KernelDispatcher(CPUDispatcher):
    """A function compiled for Python and, apart from that, for the kernels that call it."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=KernelCompiler)
        self._cache: Any = KernelCache(function, "kernel")

    @cached_property
    def _part(self) -> Any:
        """Code that kernels call; where all compiled code is on disk, nothing asks for it."""
        compiler = FastPartCompiler if self.targetoptions["fastmath"] else PartCompiler
        bare = {**self.targetoptions, "no_cpython_wrapper": True}
        part: Any = CPUDispatcher(self.py_func, targetoptions=bare, pipeline_class=compiler)
        part._cache = KernelCache(self.py_func, "part")
        return part

    def get_call_template(self, arguments: Any, keywords: Any) -> Any:
        """Types of a call by a kernel.

        The number 3 takes the code of any integer; Numba compiles one for each.
        """
        named = {name: types.unliteral(kind) for name, kind in keywords.items()}
        return self._part.get_call_template(tuple(map(types.unliteral, arguments)), named)

    def get_overload(self, signature: Any) -> Any:
        """Code that a kernel calls."""
        return self._part.get_overload(signature)


class CompileProgress(event.Listener):
    """A line on a terminal's or a notebook's standard error, written anew for every kernel.

    It shows how many of the kernels that the called one needs are compiled; those that are read
    from disk are not counted. Elsewhere, in a file for one, nothing is written.
    """

    def __init__(self) -> None:
        self._needed: set[Any] = set()
        self._total = self._depth = self._width = 0
        self._began = 0.0

    def on_start(self, event: Any) -> None:
        """Count what has to be compiled, if nothing was under way."""
        if not self._depth:
            self._needed = kernels_needed(event.data["dispatcher"])
            self._total, self._began = len(self._needed), time.perf_counter()
        self._depth += 1
        self._write()

    def on_end(self, event: Any) -> None:
        """Count one more; clear the line after the last."""
        self._depth -= 1
        self._needed.discard(event.data["dispatcher"].py_func)
        if self._depth:
            self._write()
        else:
            self._show("")

    def _write(self) -> None:
        done, seconds = self._total - len(self._needed), time.perf_counter() - self._began
        counted = f"{done} of {self._total}, {seconds:.0f} s"
        self._show(f"Compiling solvers, once for this version: {counted}")

    def _show(self, text: str) -> None:
        stream = sys.stderr
        if not (_is_notebook() or stream.isatty()):
            return
        stream.write(f"\r{text.ljust(self._width)}\r")
        stream.flush()
        self._width = len(text)


def kernels_needed(dispatcher: Any) -> set[Any]:
    """Functions of a kernel, and of all that it calls, that have no code in this process yet."""
    found: set[Any] = set()
    waiting = [dispatcher]
    while waiting:
        one = waiting.pop()
        new = isinstance(one, CPUDispatcher) and one.py_func not in found
        if new and not _is_compiled(one):
            found.add(one.py_func)
            names = one.py_func.__code__.co_names
            waiting.extend(one.py_func.__globals__.get(name) for name in names)
    return found


def _is_compiled(dispatcher: CPUDispatcher) -> bool:
    """True if there is code for Python or for other kernels."""
    part = dispatcher._part if isinstance(dispatcher, KernelDispatcher) else dispatcher
    return bool(dispatcher.overloads or part.overloads)


def _is_notebook() -> bool:
    return "ipykernel" in sys.modules


class KernelLibrary(JITCodeLibrary):
    """Code of a kernel that Python calls.

    LLVM's rewriting of the addresses in loops is left out: it takes more than a quarter of the time
    of writing machine code, and kernels are as fast without.
    """

    def _finalize_final_module(self) -> None:
        binding.set_option("cadalign", "-disable-lsr=true")
        try:  # Numba's lock keeps other compilations out
            super()._finalize_final_module()
        finally:
            binding.set_option("cadalign", "-disable-lsr=false")


_KIND = "part"


class PartLibrary(JITCodeLibrary):
    """Code that is linked into kernels, and has no address of its own.

    Left alone, Numba optimizes every function, makes it executable, and does both again as a part
    of each function that calls it, at every level. Here, what kernels call is kept as intermediate
    code and optimized where it ends up: in a kernel that Python calls.
    """

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

    library: type[JITCodeLibrary] = KernelLibrary

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


event.register("numba:compile", CompileProgress())
