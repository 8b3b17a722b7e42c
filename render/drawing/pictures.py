"""Pictures of one model: its outline and edges, keypoints, views and contact sheets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from cadalign.arrays import FloatArray
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
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
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
    points_3d: FloatArray,
    cam_from_model: Alignment,
    visible: npt.NDArray[np.bool_],
) -> ByteImage:
    """Draw numbered keypoints (k, 3) over a picture: ``visible`` ones (k,) yellow, others grey."""
    canvas = Canvas(image)
    in_camera = cam_from_model.apply(points_3d)
    inside = seen_in_image(camera, in_camera)
    # The seen ones last, on top of the others.
    for row in sorted(np.flatnonzero(inside), key=lambda row: bool(visible[row])):
        color = _SEEN_COLOR if visible[row] else _HIDDEN_COLOR
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


def contact_sheet(pictures: Mapping[str, ByteImage]) -> ByteImage:
    """Put pictures of one size side by side, each with its name beneath."""
    height, width = next(iter(pictures.values())).shape[:2]
    across = int(np.ceil(np.sqrt(len(pictures))))
    down = -(-len(pictures) // across)
    gap = max(4, min(height, width) // 40)
    line = max(14, height // 16)
    size = (across * (width + gap) + gap, down * (height + line + gap) + gap)
    sheet = Image.new("RGB", size, LIGHT_GREY)
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=0.72 * line)
    for number, (label, image) in enumerate(pictures.items()):
        left = gap + number % across * (width + gap)
        top = gap + number // across * (height + line + gap)
        sheet.paste(Image.fromarray(image), (left, top))
        middle = (left + width / 2, top + height + line / 2)
        pen.text(middle, label, fill=_TEXT_COLOR, font=font, anchor="mm")
    return np.array(sheet)
