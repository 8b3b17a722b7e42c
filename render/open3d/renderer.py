"""Drawing by ray casting with Open3D's `RaycastingScene`."""

from __future__ import annotations

from operator import attrgetter

from cadalign.errors import RenderError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.frame import Frame
from cadalign.render.raycast.renderer import RaycastRenderer
from cadalign.render.raycast.shading import Studio
from cadalign.render.scene import Scene


class Open3DRenderer:
    """Draws as `RaycastRenderer` does, but Open3D finds what the rays hit.

    Parameters
    ----------
    studio : Studio, optional
        The lights.

    Raises
    ------
    RenderError
        If Open3D cannot be imported.
    """

    name = "open3d"

    def __init__(self, *, studio: Studio | None = None) -> None:
        try:
            import cadalign.render.open3d.engine
        except (ImportError, OSError) as error:  # OSError: a library of the system is missing
            raise RenderError(
                f"Open3D cannot be imported ({error})",
                where="open3d",
                fix="run `cadalign doctor` to see what is missing, or use the ray-cast renderer",
            ) from None
        _ = cadalign.render.open3d.engine
        self._inner = RaycastRenderer(studio=studio, caster_of=attrgetter("open3d_caster"))

    @property
    def studio(self) -> Studio:
        """The lights."""
        return self._inner.studio

    def render(
        self, scene: Scene, camera: Camera, cam_from_model: Alignment, *, samples: int = 8
    ) -> Frame:
        """Draw a scene; see `RaycastRenderer.render`."""
        return self._inner.render(scene, camera, cam_from_model, samples=samples)
