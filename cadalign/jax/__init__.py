"""Alignment in JAX programs: fits with gradients.

Needs the extra ``jax``: ``pip install "cadalign[jax]"``. Fits run in the compiled kernels, on the
processor; gradients are those of the optimum, by the implicit function theorem.
"""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.jax.fits import FitArrays, fit

__all__ = ["FitArrays", "fit"]

__getattr__ = lazy_names(__name__)
