"""Overlays: boxes, axes and keypoints of an alignment drawn over its photo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import BOX_EDGES, Box
from cadalign.geometry.camera import Camera
from cadalign.render.drawing.canvas import ByteImage, Canvas, Color, LegendEntry, composite
from cadalign.render.drawing.layers import KeypointMarks, draw_lines, with_model
from cadalign.render.raycast.posed import within_lens_field
from cadalign.render.scene import LIGHT_GREY, Geometry, check_image_size

GT_COLOR: Color = (40, 205, 80)
EST_COLOR: Color = (240, 50, 50)
# Red-ish, green-ish and blue-ish, but none of them a box's colour.
AXIS_COLORS: tuple[Color, Color, Color] = ((255, 150, 60), (110, 235, 205), (95, 150, 255))

_HIDDEN_OPACITY = 0.6
# Lines are cut off this many images away.
_CUT_OFF = 20
_LINE_POINTS = 65


@dataclass(frozen=True)
class _Stroke:
    """A line to be drawn: the farther away, the sooner."""

    depth: float
    points: FloatArray
    color: Color
    is_hidden: bool = False
    """Behind the box itself."""
    arrow: str = ""
    """The letter at its tip."""


def draw_overlay(
    image: npt.ArrayLike,
    camera: Camera,
    *,
    gt_box: Box | None = None,
    est_box: Box | None = None,
    est_frame: Geometry | None = None,
    observed: npt.ArrayLike | None = None,
    reprojected: npt.ArrayLike | None = None,
    unseen: npt.ArrayLike | None = None,
    regions: npt.ArrayLike | None = None,
    outliers: npt.ArrayLike | None = None,
    axes: bool = True,
    legend: bool = True,
) -> ByteImage:
    """Draw an alignment over its image.

    The true box is green, the predicted one red; their far edges are dashed. Three arrows run from
    the predicted box's centre (or the true one's, without a prediction) to its faces, so that
    their lengths show the stretch. The predicted model itself lies over the photo with its
    edges. Observed keypoints are white rings, reprojected ones yellow
    crosses, and a thin line between the two is the residual. Keypoints that were not observed are
    small rings, and thin curves hold those that are uncertain. What lies behind the camera is cut
    off.

    Parameters
    ----------
    image : (h, w), (h, w, 3) or (h, w, 4) uint8
        Grey, RGB or RGBA (put on light grey), of the camera's size.
    camera : Camera
    gt_box, est_box : Box, optional
        The true and the predicted box, in the camera frame.
    est_frame : Geometry, optional
        The predicted model for this camera: a `Frame` of `RaycastRenderer` is shown in its own
        colours, what `cast_geometry` gives as a red veil.
    observed, reprojected : (k, 2) float, optional
        Keypoints [px]; if both are given they belong together, row by row. Reprojected ones that
        are not finite, behind the camera, are left out.
    unseen : (n, 2) float, optional
        Predicted keypoints that were not observed [px].
    regions : (r, j, 2) float, optional
        Outlines of regions that hold keypoints [px]; see
        `cadalign.render.drawing.layers.confidence_regions`.
    outliers : (n, 2) float, optional
        Observed keypoints that the estimate left out [px]: their rings are grey.
    axes : bool
        Whether to draw the axes.
    legend : bool
        Whether to draw it.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If the image is of another kind or size, or the keypoints don't match.
    RenderError
        If the image is too large.

    Examples
    --------
    >>> camera = Camera.from_fov(320, 240, fov_x=60.0)
    >>> box = Box([0, 0, 4], np.eye(3), [1, 2, 1])
    >>> draw_overlay(np.zeros((240, 320), np.uint8), camera, gt_box=box).shape
    (240, 320, 3)
    """
    check_image_size(camera)
    pixels = _as_rgb(image, camera)
    if est_frame is not None:
        pixels = with_model(pixels, est_frame, EST_COLOR)
    canvas = Canvas(pixels)
    if est_frame is not None:
        draw_lines(canvas, est_frame, EST_COLOR)
    marks = KeypointMarks.checked(observed, reprojected, unseen, regions, outliers)
    strokes: list[_Stroke] = []
    for box, color in ((gt_box, GT_COLOR), (est_box, EST_COLOR)):
        if box is not None:
            strokes += _edge_strokes(box, color, camera)
    main_box = (est_box or gt_box) if axes else None
    if main_box is not None:
        strokes += _axis_strokes(main_box, camera)
    _draw_strokes(canvas, strokes)
    marks.draw(canvas)
    entries: list[LegendEntry] = []
    if gt_box is not None:
        entries.append(("ground truth", GT_COLOR, "line"))
    if est_box is not None or est_frame is not None:
        entries.append(("prediction", EST_COLOR, "line"))
    if main_box is not None:
        names = zip("xyz", AXIS_COLORS, strict=True)
        entries += [(f"{name} axis", color, "line") for name, color in names]
    entries += marks.legend
    if legend and entries:
        lines = [stroke.points for stroke in strokes]
        canvas.legend(entries, keep_clear=np.concatenate([*lines, marks.pixels]))
    return canvas.finished()


def _as_rgb(image: Any, camera: Camera) -> ByteImage:
    """Turn the image into RGB (h, w, 3), or say what is wrong with it."""
    pixels = np.asarray(image)
    if pixels.dtype != np.uint8:
        raise InputError(
            f"its values are {pixels.dtype}, not uint8", where="image", fix="scale it to 0 to 255"
        )
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4):
        raise InputError(f"shape {np.shape(image)} is not a grey, RGB or RGBA image", where="image")
    if pixels.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"it is {pixels.shape[1]} x {pixels.shape[0]} px, the camera's image "
            f"{camera.width} x {camera.height}",
            where="image",
            fix="give the image that the camera belongs to",
        )
    if pixels.shape[2] == 1:
        return np.repeat(pixels, 3, axis=2)
    if pixels.shape[2] == 4:
        return composite(pixels, LIGHT_GREY)
    return pixels


def _edge_strokes(box: Box, color: Color, camera: Camera) -> list[_Stroke]:
    """A box's edges, those behind the box itself hidden."""
    strokes: list[_Stroke] = []
    corners = box.corners
    # Where the camera is, along each axis from the centre, in half extents.
    position = -(box.center @ box.rotation)
    half = box.extents / 2
    shows = {(k, sign): sign * position[k] > half[k] for k in range(3) for sign in (-1, 1)}
    inside = not any(shows.values())
    for first, second in BOX_EDGES:
        across = [k for k in range(3) if not (first ^ second) >> k & 1]
        faces = [(k, 1 if first >> k & 1 else -1) for k in across]
        is_hidden = not (inside or any(shows[face] for face in faces))
        strokes += _strokes(corners[[first, second]], camera, color, is_hidden=is_hidden)
    return strokes


def _axis_strokes(box: Box, camera: Camera) -> list[_Stroke]:
    strokes: list[_Stroke] = []
    for k, (name, color) in enumerate(zip("xyz", AXIS_COLORS, strict=True)):
        tip = box.center + box.rotation[:, k] * box.extents[k] / 2
        strokes += _strokes(np.array([box.center, tip]), camera, color, arrow=name)
    return strokes


def _strokes(ends: FloatArray, camera: Camera, color: Color, **style: Any) -> list[_Stroke]:
    """Project a segment (2, 3); none if it is not seen, several if a lens cuts it up."""
    points = ends[0] + np.linspace(0, 1, _LINE_POINTS)[:, None] * (ends[1] - ends[0])
    pixels = camera.project_where_ahead(points)
    kept = within_lens_field(camera, points)
    kept &= np.abs(pixels).max(axis=1) < _CUT_OFF * max(camera.width, camera.height)
    runs = np.split(np.arange(_LINE_POINTS), np.flatnonzero(np.diff(kept)) + 1)
    depth = np.linalg.norm(points, axis=1)
    return [
        _Stroke(float(depth[run].mean()), pixels[run], color, **style)
        for run in runs
        if kept[run[0]] and len(run) > 1
    ]


def _draw_strokes(canvas: Canvas, strokes: list[_Stroke]) -> None:
    """Hidden edges thin, dashed and faint; then the others, the nearest last."""
    by_depth = sorted(strokes, key=lambda stroke: -stroke.depth)
    before = canvas.image.copy()
    for stroke in by_depth:
        if stroke.is_hidden:
            canvas.line(stroke.points, stroke.color, width=1.2, dashed=True)
    canvas.blend_from(before, opacity=_HIDDEN_OPACITY)
    for stroke in by_depth:
        if stroke.is_hidden:
            continue
        if stroke.arrow:
            canvas.arrow(stroke.points[0], stroke.points[-1], stroke.color, width=2.0)
        else:
            canvas.line(stroke.points, stroke.color, width=2.0)
            for end in stroke.points[[0, -1]]:
                # Fills the notch that a casing cuts into the edge it meets.
                canvas.dot(end, stroke.color, radius=1.2)
    for stroke in strokes:
        if stroke.arrow:
            along = stroke.points[-1] - stroke.points[0]
            ahead = along / max(float(np.linalg.norm(along)), 1e-9) * 11 * canvas.unit
            canvas.label(stroke.arrow, stroke.points[-1] + ahead, stroke.color)
