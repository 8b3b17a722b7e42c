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


def translation_error_up_to_scale(*, est: Alignment, gt: Alignment) -> float:
    """Distance of the true translation from the ray through the estimated one [model units].

    One image does not tell a large object far away from a small one nearby: the estimate may be
    scaled about the camera centre by any factor from 0 up. This is the error that remains for the
    best factor, the norm of the true translation times the sine of the angle between the two; all
    of the norm beyond 90 degrees.

    Examples
    --------
    >>> est = Alignment(np.eye(3), [0, 0, 8], np.ones(3))
    >>> translation_error_up_to_scale(est=est, gt=Alignment(np.eye(3), [0, 3, 4], np.ones(3)))
    3.0
    """
    square = float(est.translation @ est.translation)
    factor = max(float(est.translation @ gt.translation) / square, 0.0) if square > 0 else 0.0
    return float(np.linalg.norm(factor * est.translation - gt.translation))


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
    _check_volumes(est, gt)
    # A unit of about the boxes' own size keeps Qhull's tolerances meaningful.
    unit = max(float(est.extents.max()), float(gt.extents.max()))
    intersection = _intersection_volume(est, gt, unit)
    volumes = (est.volume + gt.volume) / unit**3
    return float(np.clip(intersection / (volumes - intersection), 0.0, 1.0))


def box_iou_up_to_scale(*, est: Box, gt: Box) -> float:
    """Largest box IoU over all factors by which the estimate is scaled about the origin, 0 to 1.

    The origin is the camera centre, of which one image does not tell an object's distance. Unlike
    the IoU at equal distances of the two centres, this one does not change if estimate and truth
    are exchanged, and a wrong length along the line of sight costs no more than it must.

    Global, to 1e-6. Where the boxes s E and G intersect, the cube root of the intersection's volume
    is a concave function of s (Brunn-Minkowski; the pairs of s and a point of s E form a convex
    cone), and that of the sum of their volumes is convex. The IoU increases with the ratio of the
    two, which therefore has no local maximum but the global one: a bounded scalar search finds it.
    A linear program gives the range of s.

    Raises
    ------
    InputError
        If a box has no volume: the ratio means nothing then.

    Examples
    --------
    >>> gt = Box([0, 0, 4], np.eye(3), [2, 2, 2])
    >>> half = Box([0, 0, 2], np.eye(3), [1, 1, 1])
    >>> box_iou(est=half, gt=gt) < 0.01, round(box_iou_up_to_scale(est=half, gt=gt), 9)
    (True, 1.0)
    """
    from scipy.optimize import minimize_scalar

    _check_volumes(est, gt)
    found = _common_factors(est, gt)
    if found is None:
        return 0.0
    low, high = found

    def loss(logarithm: float) -> float:
        factor = np.exp(logarithm)
        return -box_iou(est=Box(factor * est.center, est.rotation, factor * est.extents), gt=gt)

    # A perfect estimate has its maximum in a kink, which the search only comes close to.
    likely = [np.cbrt(gt.volume / est.volume)]
    if est.center.any() and gt.center.any():
        likely.append(np.linalg.norm(gt.center) / np.linalg.norm(est.center))
    losses = [loss(float(np.log(factor))) for factor in likely]
    bounds = float(np.log(low)), float(np.log(high))
    search = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    return -min(float(search.fun), *losses)


def alignment_box_iou(*, est: Alignment, gt: Alignment, bounds: npt.ArrayLike) -> float:
    """Box IoU of one model, with bounds (2, 3), under two alignments; see `box_iou`."""
    bounds = as_floats(bounds, name="bounds", shape=(2, 3))
    return box_iou(est=Box.from_model(bounds, est), gt=Box.from_model(bounds, gt))


def _check_volumes(est: Box, gt: Box) -> None:
    for name, box in (("est", est), ("gt", gt)):
        if not (box.extents > 1e-9 * box.extents.max()).all():
            raise InputError(
                f"the box {box.extents.tolist()} has no volume",
                where=name,
                fix="leave flat models out of volume metrics",
            )


def _common_factors(est: Box, gt: Box) -> tuple[float, float] | None:
    """Range of the factors at which the scaled estimate meets the truth; None if there are none.

    Factors at which one volume is over 1e9 times the other are left out.
    """
    from scipy.optimize import linprog

    equal = float(np.cbrt(gt.volume / est.volume))
    unit = float(gt.extents.max())
    # Points x [units], factors s [of equal volumes]: |E' (x - s c)| <= s h, |G' (x - d)| <= k.
    scaled = equal / unit
    offset, half = scaled * (est.rotation.T @ est.center), scaled * est.extents / 2
    fixed, reach = gt.rotation.T @ gt.center / unit, gt.extents / (2 * unit)
    rows = np.vstack(
        [
            np.column_stack([-offset - half, est.rotation.T]),
            np.column_stack([offset - half, -est.rotation.T]),
            np.column_stack([np.zeros(3), gt.rotation.T]),
            np.column_stack([np.zeros(3), -gt.rotation.T]),
        ]
    )
    limits = np.concatenate([np.zeros(6), reach + fixed, reach - fixed])
    bounds = [(1e-3, 1e3), (None, None), (None, None), (None, None)]
    ends = []
    for sign in (1.0, -1.0):
        found = linprog([sign, 0.0, 0.0, 0.0], A_ub=rows, b_ub=limits, bounds=bounds)
        if not found.success:
            return None
        ends.append(equal * float(found.x[0]))
    return (ends[0], ends[1]) if ends[0] < ends[1] else None


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
