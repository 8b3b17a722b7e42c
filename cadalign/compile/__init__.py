"""Decorators that compile kernels with Numba and cache their code on disk.

No other module of cadalign calls Numba's compiler.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, TypeVar, cast

import numba
from numba.extending import overload

try:
    from cadalign.compile.once import KernelDispatcher
except (ImportError, AttributeError):  # this version of Numba lacks a private name
    KernelDispatcher = None  # type: ignore[assignment, misc]

__all__ = ["borrow", "fast_sums", "inline", "kernel", "kernel_family", "unrolled"]

unrolled = numba.literal_unroll
"""Iterate over a tuple of mixed types; the loop body is compiled for each type."""

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile on first use, cache the code on disk, and release the GIL while it runs.

    Floating-point operations keep their order and rounding, so that results are identical bit for
    bit. Fused multiply-adds, for example, differ between fresh code and code read from disk.
    """
    return _compile(function)


def fast_sums(function: F) -> F:
    """Like `kernel`, but sums may be reordered, so that they use SIMD instructions."""
    return _compile(function, fastmath={"reassoc"})


def inline(function: F) -> F:
    """Like `borrow`, for a small function that is always inlined into its callers."""
    return _compile(function, forceinline=True, counts=False)


def borrow(function: F) -> F:
    """Like `kernel`, without reference counts, for a function that allocates no array.

    It must not return an array either. Numba counts references with atomic operations: a hundred
    of them take as long as an iteration with ten keypoints.
    """
    return _compile(function, counts=False)


def _compile(function: F, *, counts: bool = True, **chosen: Any) -> F:
    # A function inherits an option that is not set here from the kernel that calls it.
    options: Any = {"nogil": True, "error_model": "numpy", "boundscheck": False}
    options |= {"fastmath": False, "forceinline": False, **chosen}
    if KernelDispatcher is None:
        return cast(F, numba.njit(cache=True, **options)(function))
    own = {"nopython": True, "_nrt": counts, "no_cfunc_wrapper": True}
    return cast(F, KernelDispatcher(function, options | own))


class KernelFamily(Protocol):
    """See `kernel_family`."""

    def of(self, kind: type) -> Callable[[F], F]: ...
    def __call__(self, first: Any, *others: Any) -> Any: ...


def kernel_family(name: str) -> KernelFamily:
    """Create a kernel that dispatches on the type of its first argument, at compile time.

    ``@family.of(kind)`` registers the member for a type of NamedTuple. A kernel that calls the
    family is compiled once for each of these types.
    """
    members: dict[type, Any] = {}

    def family(first: Any, *others: Any) -> Any:
        return members[type(first)](first, *others)

    def of(kind: type) -> Any:
        return partial(members.setdefault, kind)

    @overload(family)
    def choose(first, *others):  # type: ignore[no-untyped-def]
        member = members[first.instance_class]
        return lambda first, *others: member(first, *others)

    family.__name__ = name
    family.of = of  # type: ignore[attr-defined]
    return cast(KernelFamily, family)
