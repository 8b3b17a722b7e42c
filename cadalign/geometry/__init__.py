"""Cameras, alignments, boxes and meshes, and their conventions."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.geometry.conventions import (
        opengl_from_model,
        opengl_projection,
    )
    from cadalign.geometry.symmetry import SymmetryAxis

__all__ = [
    "SymmetryAxis",
    "opengl_from_model",
    "opengl_projection",
]

__getattr__ = lazy_names(__name__)
