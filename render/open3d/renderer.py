"""Drawing by ray casting with Open3D's `RaycastingScene`."""

from __future__ import annotations

from importlib import import_module
from operator import attrgetter

from cadalign.errors import RenderError
from cadalign.render.raycast.renderer import RaycastRenderer
from cadalign.render.raycast.shading import Studio


class Open3DRenderer(RaycastRenderer):
    """Draws as `RaycastRenderer` does; Open3D finds the hits."""

    name = "open3d"

    def __init__(self, *, studio: Studio | None) -> None:
        try:
            import_module("cadalign.render.open3d.engine")
        except (ImportError, OSError) as error:  # OSError: a library of the system is missing
            raise RenderError(
                f"Open3D cannot be imported ({error})",
                where="open3d",
                fix="run `cadalign doctor` to see what is missing, or use the ray-cast renderer",
            ) from None
        super().__init__(studio=studio, caster_of=attrgetter("open3d_caster"))
