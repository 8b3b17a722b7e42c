"""Cameras, alignments, boxes and meshes."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.geometry.mesh import Material

__all__ = ["Material"]

__getattr__ = lazy_names(__name__)
