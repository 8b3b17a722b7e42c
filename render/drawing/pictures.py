"""Plain pictures of geometry: depth, normals, faces, keypoints, lines."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import as_points
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import OPENGL_AXES
from cadalign.render.drawing.canvas import ByteImage, Canvas
from cadalign.render.scene import Geometry
from cadalign.render.viewpoints import seen_in_image

_SEEN_COLOR = (255, 222, 40)
_HIDDEN_COLOR = (150, 160, 175)
_LINE_COLOR = (30, 34, 40)
# Neighbouring pixels whose normals differ by more than this [degrees] lie on both sides of an edge.
_EDGE_ANGLE = 25.0
# And those whose depths differ by more than this share of what the slope explains.
_DEPTH_STEP = 0.02


def depth_picture(geometry: Geometry) -> ByteImage:
    """Depth as colour: yellow is near, violet far, within what is seen; transparent elsewhere.

    Returns
    -------
    (h, w, 4) uint8

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> flat = Geometry(one, np.zeros((1, 1), np.int32), np.zeros((1, 1, 3), np.float32))
    >>> depth_picture(flat).shape
    (1, 1, 4)
    """
    depth = geometry.depth
    share = np.zeros(depth.shape)
    if geometry.mask.any():
        near, far = depth[geometry.mask].min(), depth[geometry.mask].max()
        share = (far - depth) / (far - near if far > near else 1.0)
    levels = (np.clip(share, 0, 1) * 255 + 0.5).astype(np.uint8)
    colored = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    return _with_mask(colored[:, :, ::-1].reshape(*depth.shape, 3), geometry)


def normal_picture(geometry: Geometry) -> ByteImage:
    """Normals as colour: red to the right, green upwards, blue towards the camera.

    Returns
    -------
    (h, w, 4) uint8
    """
    turned = geometry.normal * OPENGL_AXES.astype(np.float32)
    return _with_mask((127.5 * (turned + 1) + 0.5).astype(np.uint8), geometry)


def face_picture(geometry: Geometry) -> ByteImage:
    """Each triangle in a colour of its own, the same in every view.

    Returns
    -------
    (h, w, 4) uint8
    """
    # Multiplying by a large odd number spreads neighbouring numbers (Knuth, TAOCP 6.4).
    mixed = (geometry.face_id.astype(np.int64) + 1) * 2654435761 % (1 << 32)
    channels = [(mixed >> shift) % 192 + 48 for shift in (0, 9, 18)]
    return _with_mask(np.stack(channels, axis=2).astype(np.uint8), geometry)


def line_picture(geometry: Geometry) -> ByteImage:
    """Outlines and edges of what is seen, dark on nothing, one pixel wide.

    Drawn from what each pixel sees, so hidden lines are hidden, and meshes whose triangles share
    no vertices show their edges as well.

    Returns
    -------
    (h, w, 4) uint8
        The lines' opacity is 0 or 255: draw at twice the size and shrink to smooth them.
    """
    lines = feature_lines(geometry)
    result: ByteImage = np.zeros((*lines.shape, 4), dtype=np.uint8)
    result[:, :, :3] = _LINE_COLOR
    result[:, :, 3] = 255 * lines
    return result


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
    numbers: bool = True,
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
    numbers : bool
        Whether to write each one's row beside it.

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
        place = canvas.place(camera.project(in_camera[row : row + 1]))[0]
        canvas.ring(place, color, radius=4)
        if numbers:
            canvas.label(str(row), place + np.array([11, -9]) * canvas.unit, color)
    return canvas.finished()


def _with_mask(rgb: npt.NDArray[np.uint8], geometry: Geometry) -> ByteImage:
    opaque = np.full((*rgb.shape[:2], 1), 255, dtype=np.uint8)
    return np.concatenate([rgb, opaque], axis=2) * geometry.mask[:, :, None]
