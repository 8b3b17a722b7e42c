"""Overlays: draw an alignment's model, box, axes and keypoints over its photo."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import BOX_EDGES, Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.images import read_image
from cadalign.io.meshes.files import load_mesh, mesh_at
from cadalign.io.observation import Observation
from cadalign.render.canvas import ByteImage, Canvas, Color, LegendEntry, composite
from cadalign.render.layers import KeypointMarks, blend_model, confidence_regions, draw_lines
from cadalign.render.posed_scene import within_lens_field
from cadalign.render.raycast import RaycastRenderer, cast_geometry
from cadalign.render.scene import LIGHT_GREY, Geometry, Scene, check_image_size

logger = logging.getLogger("cadalign")

GT_COLOR: Color = (40, 205, 80)
EST_COLOR: Color = (240, 50, 50)
# Reddish, greenish and bluish, but different from the boxes' colours.
AXIS_COLORS: tuple[Color, Color, Color] = ((255, 150, 60), (110, 235, 205), (95, 150, 255))

_HIDDEN_OPACITY = 0.6
_CUT_OFF = 20  # image sizes away, where lines end
_LINE_POINTS = 65
_SAME = 1e-9  # of the model's size
_INSIDE = 0.5  # least probability of a pixel of the object
_CONTOUR_COLOR = (70, 190, 250)


@dataclass(frozen=True)
class _Stroke:
    """A line to draw."""

    depth: float
    points: FloatArray
    color: Color
    is_hidden: bool = False
    """Whether its own box hides it."""
    arrow: str = ""
    """Letter at the tip of an arrow; empty for a plain line."""


def draw_overlay(
    image: npt.ArrayLike,
    camera: Camera,
    *,
    gt_box: Box | None = None,
    est_box: Box | None = None,
    est_frame: Geometry | None = None,
    skeleton: npt.ArrayLike = (),
    observed: npt.ArrayLike | None = None,
    reprojected: npt.ArrayLike | None = None,
    unseen: npt.ArrayLike | None = None,
    regions: npt.ArrayLike | None = None,
    outliers: npt.ArrayLike | None = None,
    axes: bool = True,
    legend: bool = True,
) -> ByteImage:
    """Draw an alignment over its image.

    The true box is green, the predicted one red; hidden edges are dashed. Three arrows run from the
    centre of the predicted box (of the true box without a prediction) to its faces: their lengths
    show the stretch. Observed keypoints are white rings, reprojected ones yellow crosses, and a
    thin line between the two is the residual. Keypoints that were not observed are small rings, and
    thin curves are confidence regions. Parts behind the camera are not drawn.

    Parameters
    ----------
    image : (h, w), (h, w, 3) or (h, w, 4) uint8
        Grey, RGB or RGBA (over light grey), of the camera's size.
    camera : Camera
    gt_box, est_box : Box, optional
        The true and the predicted box, in the camera frame.
    est_frame : Geometry, optional
        The predicted model, rendered with this camera: a `Frame` is drawn in its own colours, the
        geometry of `cast_geometry` as a red veil.
    skeleton : (s, 2, 3) float
        Thin lines between predicted keypoints, in the camera frame.
    observed, reprojected : (k, 2) float, optional
        Keypoints [px]; if both are given, their rows correspond. Reprojected ones that are not
        finite (behind the camera) are omitted.
    unseen : (n, 2) float, optional
        Predicted keypoints that were not observed [px].
    regions : (r, j, 2) float, optional
        Outlines of confidence regions of keypoints [px], as of `confidence_regions`.
    outliers : (n, 2) float, optional
        Observed keypoints that the estimate rejected [px]: their rings are grey.
    axes : bool
        Whether to draw the axes.
    legend : bool
        Whether to draw the legend.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If the image has the wrong type or size, or the keypoints' shapes don't match.
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
        pixels = blend_model(pixels, est_frame, EST_COLOR)
    canvas = Canvas(pixels)
    if est_frame is not None:
        draw_lines(canvas, est_frame, EST_COLOR)
    marks = KeypointMarks.from_arrays(observed, reprojected, unseen, regions, outliers)
    for ends in np.asarray(skeleton, dtype=float):
        for stroke in _strokes(ends, camera, EST_COLOR):
            canvas.hairline(stroke.points, stroke.color)
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
    return canvas.finish()


def _as_rgb(image: Any, camera: Camera) -> ByteImage:
    """Convert an image to RGB (h, w, 3); raises InputError if it does not fit the camera."""
    pixels = np.asarray(image)
    if pixels.dtype != np.uint8:
        raise InputError(
            f"its values are {pixels.dtype}, not uint8", where="image", fix="scale them to 0 to 255"
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
    """Edges of a box; those that the box itself hides are marked."""
    strokes: list[_Stroke] = []
    corners = box.corners
    # The camera's position in the box's axes, from its centre.
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
    """Project a segment (2, 3): no stroke if it is invisible, several where a lens splits it."""
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
    """Draw hidden edges thin, dashed and faint; then the others, the nearest last."""
    by_depth = sorted(strokes, key=lambda stroke: -stroke.depth)
    before = canvas.image.copy()
    for stroke in by_depth:
        if stroke.is_hidden:
            canvas.line(stroke.points, stroke.color, width=1.2, dashed=True)
    canvas.fade(before, opacity=_HIDDEN_OPACITY)
    for stroke in by_depth:
        if stroke.is_hidden:
            continue
        if stroke.arrow:
            canvas.arrow(stroke.points[0], stroke.points[-1], stroke.color, width=2.0)
        else:
            canvas.line(stroke.points, stroke.color, width=2.0)
            for end in stroke.points[[0, -1]]:
                # Fill the notch where the casing of one edge crosses another edge.
                canvas.dot(end, stroke.color, radius=1.2)
    for stroke in strokes:
        if stroke.arrow:
            along = stroke.points[-1] - stroke.points[0]
            ahead = along / max(float(np.linalg.norm(along)), 1e-9) * 11 * canvas.unit
            canvas.label(stroke.arrow, stroke.points[-1] + ahead, stroke.color)


# Results over their photos ----------------------------------------------------------------------


def overlay_model(
    image: npt.ArrayLike, camera: Camera, mesh: Mesh | Scene, alignment: Alignment
) -> ByteImage:
    """Draw an aligned, shaded model over its photo, with its edges, box and axes.

    Parameters
    ----------
    image : (h, w), (h, w, 3) or (h, w, 4) uint8
        The photo, of the camera's size.
    camera : Camera
        Its lens distortion is applied to the model, the box and the axes.
    mesh : Mesh or Scene
        The model before its stretch: ``result.mesh()`` where the shape was estimated. A `Scene`
        can be reused for many photos.
    alignment : Alignment
        Pose and stretch of the model, estimated or true.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If the image has the wrong type or size.
    RenderError
        If the image is too large.

    Examples
    --------
    >>> triangle = Mesh([[-1, -1, 0], [1, -1, 0], [0, 2, 0]], [[0, 1, 2]])
    >>> camera = Camera.from_fov(65, 49, fov_x=60.0)
    >>> photo = np.zeros((49, 65, 3), np.uint8)
    >>> pose = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> overlay_model(photo, camera, triangle, pose).shape
    (49, 65, 3)
    """
    scene = mesh if isinstance(mesh, Scene) else Scene(mesh)
    return draw_overlay(
        image,
        camera,
        est_box=Box.from_model(scene.bounds, alignment),
        est_frame=RaycastRenderer().render(scene, camera, alignment),
        legend=False,
    )


def draw_result(
    photo: npt.ArrayLike,
    result: Any,
    *,
    mesh: Mesh | None = None,
    bounds: FloatArray | None = None,
    mask: npt.NDArray[Any] | None = None,
    number: int = 0,
) -> ByteImage:
    """Draw an estimate over the photo of a view: box, mesh, and keypoints with their uncertainty.

    Confidence regions of keypoints that were not observed are drawn in the first view, or in all
    views of a rig. ``photo`` is as for `draw_overlay`, ``result`` a `cadalign.Result`, and
    ``number`` the index of the view. ``mesh`` (see `mesh_of`) and the box's ``bounds`` (2, 3) are
    in the model frame before the stretch; by default the bounds are the result's. Without a mesh
    the result's lines are drawn. The contour of ``mask`` (h, w) is drawn.
    """
    view = result.views[number]
    camera, alignment = view.camera, view.alignment
    in_camera = alignment.apply(result.points_3d)
    ahead = camera.sees(in_camera)
    seen = set(view.ids)
    unseen = ahead & np.array([label not in seen for label in result.ids], dtype=bool)
    row_of = {label: row for row, label in enumerate(result.ids)}
    own = in_camera[[row_of[label] for label in view.ids]]
    regions, is_first = None, number == 0 or result.rig_from_model is not None
    covariances = result.points_cam_covariance if result.model is not None and is_first else None
    if covariances is not None:
        turn = alignment.rotation @ result.alignment.rotation.T
        turned = turn @ covariances[ahead] @ turn.T
        projected = camera.projected_covariances(in_camera[ahead], turned)
        regions = confidence_regions(camera.project(in_camera[ahead]), projected)
    frame = None
    if mesh is not None:
        frame = cast_geometry(Scene(mesh), camera, alignment)
    return draw_overlay(
        photo if mask is None else draw_contour(np.asarray(photo), np.asarray(mask)),
        camera,
        est_box=Box.from_model(result.bounds if bounds is None else bounds, alignment),
        est_frame=frame,
        skeleton=in_camera[result.lines] if mesh is None else (),
        observed=view.points_2d,
        reprojected=camera.project_where_ahead(own),
        unseen=camera.project(in_camera[unseen]) if unseen.any() else None,
        regions=regions,
        outliers=view.points_2d[~view.inliers],
    )


def photo_of(image: Path | str | npt.ArrayLike | None, camera: Camera) -> npt.NDArray[Any]:
    """Pixels of a photo, grey without one; raises RenderError if it is too large."""
    check_image_size(camera)
    if image is None:
        return np.full((camera.height, camera.width, 3), LIGHT_GREY, dtype=np.uint8)
    if isinstance(image, Path | str):
        return read_image(Path(image), camera)
    return np.asarray(image)


def draw_contour(image: ByteImage, mask: npt.NDArray[Any]) -> ByteImage:
    """Draw the contour of a mask (h, w) on a copy of an image."""
    inside = (mask > _INSIDE).astype(np.uint8)
    contours, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    drawn = image.copy()
    cv2.drawContours(drawn, contours, -1, _CONTOUR_COLOR, 1, cv2.LINE_AA)
    return drawn


def mesh_of(observation: Observation, result: Any) -> Mesh | None:
    """Mesh of the object in the model frame before the stretch; None where no mesh is known.

    Results of `align` warp the observation's model or the nearest training model; others have the
    model's own mesh. An unreadable training mesh gives a warning (logger "cadalign").
    """
    if result.method != "align":
        return None if observation.model is None else mesh_at(observation.model)
    from cadalign.shapes.model import ShapeModel  # takes time to import
    from cadalign.shapes.warp import warp_mesh

    model = result.model
    if model is not None and not isinstance(model, ShapeModel):
        return None if model.mesh is None else result.mesh()
    sources = {
        label: xyz
        for image, view in zip(observation.views, result.views, strict=True)
        for label, xyz in zip(view.ids, image.points_3d, strict=True)
    }
    row_of = {label: row for row, label in enumerate(result.ids)}
    source = np.array(list(sources.values())).reshape(-1, 3)
    target = result.points_3d[[row_of[label] for label in sources]]
    if observation.model is None or (model is not None and not source.any()):
        return None if model is None else drawable_mesh(result)
    mesh = load_mesh(observation.model)
    if not sources or np.abs(source - target).max() <= _SAME * np.ptp(source):
        return mesh
    return warp_mesh(mesh, source, target, bounds=result.bounds)


def drawable_mesh(result: Any, mesh: Mesh | str | os.PathLike[str] | None = None) -> Mesh | None:
    """Mesh of a result; None where no mesh is known or the training mesh is unreadable."""
    try:
        return cast(Mesh, result.mesh(mesh))
    except (InputError, DataError) as error:
        if mesh is not None:
            raise
        if isinstance(error, DataError):
            logger.warning("the nearest training model is not drawn: %s", error)
    return None
