"""A placed model over its photo: shaded or as lines, with its box and its axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError, unknown
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.render.drawing.color import ByteImage
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.drawing.pictures import LINES, SHADED, TRANSLUCENT
from cadalign.render.frame import Geometry
from cadalign.render.raycast.renderer import RaycastRenderer, cast_geometry
from cadalign.render.scene import Scene

BOX = "box"
MODES = (SHADED, TRANSLUCENT, LINES, BOX)


@dataclass(frozen=True)
class OverlayStyle:
    """Style of a model drawn over its photo.

    Raises
    ------
    InputError
        If there is no such mode, or the opacity is out of range.
    """

    mode: str = "shaded"
    """``shaded``, the model in its own colours, lit; ``translucent``, as a red veil; ``lines``, its
    visible outline and creases alone; or ``box``, the box alone."""
    opacity: float = 0.6
    """Opacity of the shaded or translucent model, 0 to 1."""
    lines: bool = True
    """Whether to draw outline and creases over the model."""
    box: bool = True
    """Whether to draw its box."""
    axes: bool = True
    """Whether to draw its x, y and z axes."""

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise unknown("mode", self.mode, MODES)
        if not 0 <= self.opacity <= 1:
            raise InputError(f"{self.opacity} is not from 0 to 1", where="opacity")


def overlay_model(
    image: npt.ArrayLike,
    camera: Camera,
    mesh: Mesh | Scene,
    alignment: Alignment,
    *,
    style: OverlayStyle | None = None,
    bounds: npt.ArrayLike | None = None,
) -> ByteImage:
    """Draw an aligned model over its photo.

    Parameters
    ----------
    image : (h, w), (h, w, 3) or (h, w, 4) uint8
        The photo, of the camera's size.
    camera : Camera
        Its lens distortion bends the model, the box and the axes.
    mesh : Mesh or Scene
        The model, before its stretch: a result's ``mesh()`` where the object's shape was estimated.
        A `Scene` is prepared once for many photos.
    alignment : Alignment
        The model's pose and stretch, of a result or the truth.
    style : OverlayStyle, optional
    bounds : (2, 3) float, optional
        The model's lowest and highest coordinates; by default the mesh's.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If the image is of another kind or size.
    RenderError
        If the image is too large.

    Examples
    --------
    >>> triangle = Mesh([[-1, -1, 0], [1, -1, 0], [0, 2, 0]], [[0, 1, 2]])
    >>> camera = Camera.from_fov(65, 49, fov_x=60.0)
    >>> photo = np.zeros((49, 65, 3), np.uint8)
    >>> pose = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> overlay_model(photo, camera, triangle, pose, style=OverlayStyle(opacity=0.8)).shape
    (49, 65, 3)
    """
    chosen = style or OverlayStyle()
    scene = mesh if isinstance(mesh, Scene) else Scene(mesh)
    box = Box.from_model(scene.bounds if bounds is None else bounds, alignment)
    return draw_overlay(
        image,
        camera,
        est_box=box if chosen.box or chosen.mode == BOX else None,
        est_frame=_drawn(scene, camera, alignment, chosen.mode),
        model_style=LINES if chosen.mode == BOX else chosen.mode,
        model_opacity=chosen.opacity,
        model_lines=chosen.lines or chosen.mode == LINES,
        axes=box if chosen.axes else False,
        legend=False,
    )


def overlay_models(
    image: npt.ArrayLike,
    camera: Camera,
    placed: Sequence[tuple[Mesh | Scene, Alignment]],
    *,
    style: OverlayStyle | None = None,
) -> ByteImage:
    """Draw several models over one photo, the farthest first; see `overlay_model`."""
    by_depth = sorted(placed, key=lambda each: -each[1].translation[2])
    drawn = np.asarray(image)
    for mesh, alignment in by_depth:
        drawn = overlay_model(drawn, camera, mesh, alignment, style=style)
    return np.asarray(drawn)


def _drawn(scene: Scene, camera: Camera, alignment: Alignment, mode: str) -> Geometry | None:
    if mode == BOX:
        return None
    if mode == LINES:
        return cast_geometry(scene, camera, alignment)
    return RaycastRenderer().render(scene, camera, alignment)
