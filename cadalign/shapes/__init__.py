"""Shape models of categories, and deformation of meshes."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.shapes.examples import Example
    from cadalign.shapes.model import ShapeModel
    from cadalign.shapes.warp import LinearWarp, linear_warp, warp_mesh

__all__ = ["Example", "LinearWarp", "ShapeModel", "linear_warp", "warp_mesh"]

__getattr__ = lazy_names(__name__)
