"""Compile kernels, keep their code on disk, and say so while it takes its time."""

from numba.core import event

from cadalign.compile.decorators import (
    CompileProgress,
    KernelFamily,
    borrowing,
    fast_sums,
    inlined,
    kernel,
)

__all__ = ["KernelFamily", "borrowing", "fast_sums", "inlined", "kernel"]

event.register("numba:compile", CompileProgress())
