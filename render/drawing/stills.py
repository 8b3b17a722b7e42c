"""Stills and turntables of one model: named views, styles, backgrounds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError, unknown
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.drawing.pictures import (
    depth_picture,
    face_picture,
    line_picture,
    normal_picture,
)
from cadalign.render.raycast.renderer import cast_geometry
from cadalign.render.scene import Renderer, Scene
from cadalign.render.viewpoints import frame_object, look_at

VIEWS: dict[str, tuple[float, float]] = {
    "iso": (145.0, 25.0),
    "front": (180.0, 0.0),
    "right": (90.0, 0.0),
    "back": (0.0, 0.0),
    "left": (-90.0, 0.0),
    "top": (180.0, 90.0),
    "bottom": (180.0, -90.0),
}
"""Azimuth and elevation [degrees] of the named views, see `look_at`; ShapeNet's models face -z."""

_PICTURES = {"depth": depth_picture, "normals": normal_picture, "faces": face_picture}
_FILL = 0.88


@dataclass(frozen=True)
class Angles:
    """Viewing angles of a model [degrees]; see `look_at`."""

    azimuth: float
    elevation: float
    roll: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Angles:
        """Read a view's name, or ``azimuth,elevation`` or ``azimuth,elevation,roll``.

        Raises
        ------
        InputError
            If it is neither.

        Examples
        --------
        >>> Angles.parse("30,-10")
        Angles(azimuth=30.0, elevation=-10.0, roll=0.0)
        """
        if text in VIEWS:
            return cls(*VIEWS[text])
        try:
            values = [float(word) for word in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (2, 3) or not np.isfinite(values).all():
            raise InputError(
                f"{text!r} is not a view",
                where="view",
                fix=f"give one of {', '.join(VIEWS)}, or azimuth,elevation[,roll] in degrees",
            )
        return cls(*values)


def pose_in_view(
    scene: Scene, camera: Camera, angles: Angles, *, scale: npt.ArrayLike = (1.0, 1.0, 1.0)
) -> Alignment:
    """Place a model so that it fills the image, looked at from some angles.

    Raises
    ------
    InputError
        If an angle or a scale is out of its range.
    """
    rotation = look_at(**asdict(angles), distance=1.0, scale=scale).rotation
    return frame_object(scene.bounds, camera, rotation=rotation, fill=_FILL, scale=scale)


def draw_still(
    renderer: Renderer,
    scene: Scene,
    camera: Camera,
    cam_from_model: Alignment,
    *,
    style: str = "color",
    samples: int = 8,
) -> ByteImage:
    """Draw a model in one of the styles; (h, w, 4) uint8, transparent where it is not.

    Raises
    ------
    InputError
        If there is no such style.
    RenderError
        If the image is too large.
    """
    if style == "color":
        return renderer.render(scene, camera, cam_from_model, samples=samples).color
    if style == "lines":
        return _smooth_lines(scene, camera, cam_from_model)
    if style not in _PICTURES:
        raise unknown("style", style, ["color", *_PICTURES, "lines"])
    return _PICTURES[style](cast_geometry(scene, camera, cam_from_model))


def turntable(
    scene: Scene,
    camera: Camera,
    angles: Angles,
    *,
    count: int,
    scale: npt.ArrayLike = (1.0, 1.0, 1.0),
) -> Iterator[Alignment]:
    """Poses that turn a model once about its y axis, at a distance that fits all of them.

    Parameters
    ----------
    scene : Scene
    camera : Camera
    angles : Angles
        Direction of the first pose.
    count : int
        Number of poses.
    scale : (3,) float
    """
    low, high = scene.bounds
    # The box about all the turned boxes: as wide as the farthest corner from the axis is.
    stretch = np.asarray(scale, dtype=float)
    middle, half = (low + high) / 2, (high - low) / 2 * stretch
    reach = float(np.hypot(half[0], half[2]))
    wide = np.array([reach, half[1], reach])
    first = look_at(azimuth=angles.azimuth, elevation=angles.elevation, distance=1.0).rotation
    placed = frame_object(np.array([-wide, wide]), camera, rotation=first, fill=_FILL)
    depth = placed.translation
    for number in range(count):
        turned = replace(angles, azimuth=angles.azimuth + 360.0 * number / count)
        rotation = look_at(**asdict(turned), distance=1.0).rotation
        yield Alignment(rotation, depth - rotation @ (middle * stretch), stretch)


def _smooth_lines(scene: Scene, camera: Camera, cam_from_model: Alignment) -> ByteImage:
    doubled = camera.resized(2 * camera.width, 2 * camera.height)
    lines = line_picture(cast_geometry(scene, doubled, cam_from_model))
    # Two pixels wide there is one pixel wide here.
    lines[:, :, 3] = cv2.dilate(lines[:, :, 3], np.ones((2, 2), np.uint8))
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(lines, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
