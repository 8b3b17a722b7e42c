"""Pictures of one model: its outline and edges, keypoints, views and contact sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from cadalign.arrays import as_points
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.drawing.canvas import ByteImage, Canvas
from cadalign.render.scene import LIGHT_GREY, Geometry, Scene
from cadalign.render.viewpoints import frame_object, look_at, seen_in_image

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

_SEEN_COLOR = (255, 222, 40)
_HIDDEN_COLOR = (150, 160, 175)
# Neighbouring pixels whose normals differ by more than this [degrees] lie on both sides of an edge.
_EDGE_ANGLE = 25.0
# And those whose depths differ by more than this share of what the slope explains.
_DEPTH_STEP = 0.02
_TEXT_COLOR = (70, 76, 84)
_FILL = 0.88  # of the image, by a still's model


def feature_lines(geometry: Geometry) -> npt.NDArray[np.bool_]:
    """Pixels on the outline of the object, or beside a fold or a step in its surface, (h, w)."""
    lines = np.zeros(geometry.depth.shape, dtype=bool)
    for axis in (0, 1):
        first = tuple(slice(None, -1) if k == axis else slice(None) for k in (0, 1))
        second = tuple(slice(1, None) if k == axis else slice(None) for k in (0, 1))
        one, other = geometry.mask[first], geometry.mask[second]
        both = one & other
        cosine = np.einsum("rck,rck->rc", geometry.normal[first], geometry.normal[second])
        near, far = geometry.depth[first], geometry.depth[second]
        # A surface that is seen edge-on changes its depth quickly without having a step.
        slope = np.maximum(np.abs(geometry.normal[first][:, :, 2]), 0.05)
        step = np.abs(near - far) * slope > _DEPTH_STEP * np.minimum(near, far)
        changes = both & ((cosine < np.cos(np.radians(_EDGE_ANGLE))) | step)
        # Of a step the line belongs to the nearer side, of an outline to the object's.
        lines[first] |= (one & ~other) | (changes & (near <= far))
        lines[second] |= (other & ~one) | (changes & (near > far))
    return lines


def keypoint_picture(
    image: ByteImage,
    camera: Camera,
    points_3d: npt.ArrayLike,
    cam_from_model: Alignment,
    *,
    visible: npt.ArrayLike | None = None,
) -> ByteImage:
    """Draw numbered keypoints over a picture: those that are seen yellow, hidden ones grey.

    Parameters
    ----------
    image : (h, w, 3) uint8
    camera : Camera
    points_3d : (k, 3) float
        In model coordinates.
    cam_from_model : Alignment
    visible : (k,) bool, optional
        Which of them are seen; by default all.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If an array has the wrong shape.
    """
    points = as_points(points_3d, name="points_3d", dimension=3)
    shown = np.ones(len(points), dtype=bool) if visible is None else np.asarray(visible, dtype=bool)
    if shown.shape != (len(points),):
        raise InputError(f"shape {shown.shape}, expected ({len(points)},)", where="visible")
    canvas = Canvas(image)
    in_camera = cam_from_model.apply(points)
    inside = seen_in_image(camera, in_camera)
    # The seen ones last, on top of the others.
    for row in sorted(np.flatnonzero(inside), key=lambda row: bool(shown[row])):
        color = _SEEN_COLOR if shown[row] else _HIDDEN_COLOR
        (place,) = camera.project(in_camera[row : row + 1])
        canvas.ring(place, color, radius=4)
        canvas.label(str(row), place + np.array([11, -9]) * canvas.unit, color)
    return canvas.finished()


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


def contact_sheet(images: Sequence[ByteImage], labels: Sequence[str]) -> ByteImage:
    """Put pictures of one size side by side, each with a label beneath.

    Parameters
    ----------
    images : sequence of (h, w, 3) uint8
    labels : sequence of str

    Returns
    -------
    (H, W, 3) uint8

    Raises
    ------
    InputError
        If there are no images, they differ in size, or there is not a label for each.
    """
    if not images or len(images) != len(labels):
        raise InputError(f"{len(images)} images and {len(labels)} labels", where="images")
    if len({image.shape for image in images}) > 1:
        raise InputError("all must have the same size", where="images")
    height, width = images[0].shape[:2]
    across = int(np.ceil(np.sqrt(len(images))))
    down = -(-len(images) // across)
    gap = max(4, min(height, width) // 40)
    line = max(14, height // 16)
    size = (across * (width + gap) + gap, down * (height + line + gap) + gap)
    sheet = Image.new("RGB", size, LIGHT_GREY)
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=0.72 * line)
    for number, (image, label) in enumerate(zip(images, labels, strict=True)):
        left = gap + number % across * (width + gap)
        top = gap + number // across * (height + line + gap)
        sheet.paste(Image.fromarray(image), (left, top))
        middle = (left + width / 2, top + height + line / 2)
        pen.text(middle, label, fill=_TEXT_COLOR, font=font, anchor="mm")
    return np.array(sheet)
