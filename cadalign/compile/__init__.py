"""Compile kernels, and keep their code on disk.

Nothing else in cadalign calls Numba's compiler.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, TypeVar, cast

import numba
from numba.extending import overload

try:
    from cadalign.compile.once import KernelDispatcher
except (ImportError, AttributeError):  # Numba has no longer what this rests on
    KernelDispatcher = None  # type: ignore[assignment, misc]

__all__ = ["borrowing", "fast_sums", "inlined", "kernel", "kernel_family", "unrolled"]

unrolled = numba.literal_unroll
"""Loop over a tuple of several types; the body is compiled for each."""

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile on first use, keep the result on disk, release the interpreter lock while running.

    Floating-point operations keep their order and rounding: contraction into fused multiply-adds,
    for one, differs between code just compiled and code read back from disk, and results must be
    the same bit for bit.
    """
    return _compiled(function)


def fast_sums(function: F) -> F:
    """Like `kernel`, but sums may be reordered, so that they run on vector units."""
    return _compiled(function, fastmath={"reassoc"})


def inlined(function: F) -> F:
    """Like `borrowing`, for a small function that is always compiled into its callers."""
    return _compiled(function, forceinline=True, counts=False)


def borrowing(function: F) -> F:
    """Like `kernel`, for a function that makes no arrays and returns none.

    It works on arrays of its callers, and does not count its references to them: Numba counts by
    atomic operations, a hundred of which take as long as an iteration with ten keypoints.
    """
    return _compiled(function, counts=False)


def _compiled(function: F, *, counts: bool = True, **chosen: Any) -> F:
    # Options that are not said are those of the kernel that calls a function.
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
    """A kernel of one name with a member for each type of its first argument.

    ``@family.of(kind)`` decorates the member for a type of NamedTuple. What calls the family is
    compiled once for each of these types, with the member of that type in it.
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
