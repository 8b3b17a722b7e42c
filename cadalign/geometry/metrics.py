"""Errors between an estimate and the truth.

All metrics take ``est`` and ``gt`` by keyword, score a perfect estimate as perfect, and refuse NaN.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera


def rotation_error(*, est: Alignment, gt: Alignment) -> float:
    """Angle of the rotation between estimate and truth [degrees], 0 to 180.

    From the chord, |R_est - R_gt| = sqrt(8) sin(angle / 2), which is exact at small angles, where
    the usual arc cosine of the trace loses half the digits (and beyond 90 degrees from the trace).

    Examples
    --------
    >>> rotation_error(est=Alignment.identity(), gt=Alignment.identity())
    0.0
    """
    chord = np.linalg.norm(est.rotation - gt.rotation) / np.sqrt(8.0)
    cosine = np.sqrt(max(0.0, (np.sum(est.rotation * gt.rotation) + 1.0) / 4.0))
    return float(np.degrees(2.0 * np.arctan2(chord, cosine)))


def translation_error(*, est: Alignment, gt: Alignment) -> float:
    """Distance between the two translations [model units]."""
    return float(np.linalg.norm(est.translation - gt.translation))


def scale_error(*, est: Alignment, gt: Alignment) -> FloatArray:
    """Relative error of the scale along each axis, |s_est - s_gt| / s_gt; (3,) float, fractions.

    Examples
    --------
    >>> est = Alignment(np.eye(3), np.zeros(3), [1, 1.5, 0.5])
    >>> scale_error(est=est, gt=Alignment.identity()).tolist()
    [0.0, 0.5, 0.5]
    """
    return np.asarray(np.abs(est.scale - gt.scale) / gt.scale)


def reprojection_error(
    *, est: Alignment, points_3d: npt.ArrayLike, points_2d: npt.ArrayLike, camera: Camera
) -> float:
    """Root mean square distance between projected model points and their observations [px].

    Parameters
    ----------
    est : Alignment
    points_3d : (n, 3) float
        Model points.
    points_2d : (n, 2) float
        Where they were observed [px].
    camera : Camera

    Raises
    ------
    InputError
        If a point lies behind the camera, or lengths don't match.
    """
    observed = as_points(points_2d, name="points_2d", dimension=2)
    projected = camera.project(est.apply(points_3d))
    if len(projected) != len(observed) or not len(observed):
        raise InputError(
            f"{len(projected)} model points, {len(observed)} observations", where="points_2d"
        )
    return float(np.sqrt(((projected - observed) ** 2).sum(axis=1).mean()))


def box_iou(*, est: Box, gt: Box) -> float:
    """Volume of the intersection of two oriented boxes over that of their union, 0 to 1.

    Exact: a vertex of the intersection lies on an edge of one box, where that edge enters or
    leaves the other box. All edges are clipped, and Qhull gives the volume of the hull of their
    ends.

    Raises
    ------
    InputError
        If a box has no volume: the ratio means nothing then.

    Examples
    --------
    >>> gt = Box([0, 0, 0], np.eye(3), [2, 2, 2])
    >>> round(box_iou(est=Box([1, 0, 0], np.eye(3), [2, 2, 2]), gt=gt), 12)
    0.333333333333
    """
    for name, box in (("est", est), ("gt", gt)):
        if not (box.extents > 1e-9 * box.extents.max()).all():
            raise InputError(
                f"the box {box.extents.tolist()} has no volume",
                where=name,
                fix="leave flat models out of volume metrics",
            )
    # A unit of about the boxes' own size keeps Qhull's tolerances meaningful.
    unit = max(float(est.extents.max()), float(gt.extents.max()))
    intersection = _intersection_volume(est, gt, unit)
    volumes = (est.volume + gt.volume) / unit**3
    return float(np.clip(intersection / (volumes - intersection), 0.0, 1.0))


def alignment_box_iou(*, est: Alignment, gt: Alignment, bounds: npt.ArrayLike) -> float:
    """Box IoU of one model, with bounds (2, 3), under two alignments; see `box_iou`."""
    bounds = as_floats(bounds, name="bounds", shape=(2, 3))
    return box_iou(est=Box.from_model(bounds, est), gt=Box.from_model(bounds, gt))


def _intersection_volume(first: Box, second: Box, unit: float) -> float:
    """Volume of the intersection, in units of ``unit`` cubed."""
    from scipy.spatial import ConvexHull, QhullError  # neither these nor compiled code need load

    from cadalign.geometry.clipping import clipped_edges  # with `import cadalign`

    extents_1, extents_2 = first.extents / unit, second.extents / unit
    axes = np.ascontiguousarray(first.rotation.T @ second.rotation)
    center = first.rotation.T @ (second.center - first.center) / unit
    vertices = np.empty((48, 3))
    count = clipped_edges(extents_2, extents_1, axes, center, vertices)
    ends = np.empty((24, 3))
    back = np.ascontiguousarray(axes.T)
    more = clipped_edges(extents_1, extents_2, back, -back @ center, ends)
    vertices[count : count + more] = ends[:more] @ back + center
    if count + more < 4:
        return 0.0
    try:
        return float(ConvexHull(vertices[: count + more]).volume)
    except QhullError:  # the boxes touch in a face, an edge or a corner
        return 0.0
