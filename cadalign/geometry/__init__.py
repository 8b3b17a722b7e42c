"""Cameras, alignments, boxes and meshes, and their conventions."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.geometry.symmetry import SymmetryAxis

__all__ = ["SymmetryAxis"]

__getattr__ = lazy_names(__name__)
