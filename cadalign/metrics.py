"""Errors between an estimate and the truth.

Metrics of alignments accept the model's ``symmetry`` and then compare with `nearest_truth`.
Functions with plural names compute the same errors, bit for bit, for stacked arrays (...), without
checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError, require_kind
from cadalign.geometry.alignment import Alignment, Box, oriented_box
from cadalign.geometry.rotations import angles_between, dots, lengths
from cadalign.geometry.symmetry import Symmetry

__all__ = [
    "box_iou",
    "box_iou_up_to_scale",
    "nearest_truth",
    "rotation_error",
    "scale_error",
    "translation_error",
    "translation_error_up_to_scale",
]

_SAME_STRETCH = 0.01  # relative difference of true scales within the accuracy of annotations
_LEAST_SIDE = 1e-9  # shortest side of a box with a volume, over the longest


class Alignments(NamedTuple):
    """Alignments of n models: rotations (n, 3, 3), translations (n, 3) and scales (n, 3)."""

    rotation: FloatArray
    translation: FloatArray
    scale: FloatArray

    @classmethod
    def stack(cls, alignments: Sequence[Alignment]) -> Alignments:
        """Stack one or more alignments."""
        return cls(
            *(np.array([getattr(each, name) for each in alignments]) for name in cls._fields)
        )


class Boxes(NamedTuple):
    """Boxes of n models: centres (n, 3), axes (n, 3, 3) and side lengths (n, 3)."""

    center: FloatArray
    rotation: FloatArray
    extents: FloatArray

    @classmethod
    def from_models(cls, bounds: FloatArray, alignments: Alignments) -> Boxes:
        """Make boxes from models' bounds (n, 2, 3); see `Box.from_model`."""
        return cls(*oriented_box(bounds, *alignments))


_Poses = Alignment | Alignments
_Boxes = Box | Boxes


def nearest_truth(est: Alignment, gt: Alignment, *, symmetry: Symmetry) -> Alignment:
    """Find the equivalent true alignment whose rotation is nearest to the estimate's.

    Alignments that differ by a symmetry of the model place the same object; see
    `cadalign.geometry.symmetry`. True scales that differ by up to 1 % count as equal.

    Examples
    --------
    >>> turned = Alignment(np.diag([-1.0, 1.0, -1.0]), [0, 0, 4], [1, 2, 3])
    >>> gt = Alignment(np.eye(3), [0, 0, 4], [1, 2, 3])
    >>> found = nearest_truth(est=turned, gt=gt, symmetry=Symmetry.around((0, 1, 0), fold=2))
    >>> bool(np.allclose(found.rotation, turned.rotation))
    True
    """
    return symmetry.canonical(gt, reference=est.rotation, tolerance=_SAME_STRETCH).alignment


def _truth(est: Alignment, gt: Alignment, symmetry: Symmetry | None) -> Alignment:
    for name, given in (("est", est), ("gt", gt)):
        require_kind(given, Alignment, name, fix="give the result's alignment")
    return gt if symmetry is None else nearest_truth(est=est, gt=gt, symmetry=symmetry)


def rotation_error(est: Alignment, gt: Alignment, *, symmetry: Symmetry | None = None) -> float:
    """Angle between the rotations of estimate and truth [degrees], 0 to 180.

    Examples
    --------
    >>> rotation_error(Alignment.identity(), Alignment.identity())
    0.0
    """
    return float(rotation_errors(est=est, gt=_truth(est, gt, symmetry)))


def translation_error(est: Alignment, gt: Alignment, *, symmetry: Symmetry | None = None) -> float:
    """Distance between the two translations [model units]."""
    return float(translation_errors(est=est, gt=_truth(est, gt, symmetry)))


def translation_error_up_to_scale(
    est: Alignment, gt: Alignment, *, symmetry: Symmetry | None = None
) -> float:
    """Distance of the true translation from the ray through the estimated one [model units].

    One image determines size and distance only up to a common factor >= 0. This is the translation
    error for the best factor: the norm of the true translation times the sine of the angle between
    the two, or the whole norm beyond 90 degrees.

    Examples
    --------
    >>> est = Alignment(np.eye(3), [0, 0, 8], np.ones(3))
    >>> translation_error_up_to_scale(est=est, gt=Alignment(np.eye(3), [0, 3, 4], np.ones(3)))
    3.0
    """
    return float(translation_errors_up_to_scale(est=est, gt=_truth(est, gt, symmetry)))


def scale_error(est: Alignment, gt: Alignment, *, symmetry: Symmetry | None = None) -> FloatArray:
    """Relative error of the scale along each axis, (3,) float: ``|s_est - s_gt| / s_gt``.

    Examples
    --------
    >>> est = Alignment(np.eye(3), np.zeros(3), [1, 1.5, 0.5])
    >>> scale_error(est=est, gt=Alignment.identity()).tolist()
    [0.0, 0.5, 0.5]
    """
    return scale_errors(est=est, gt=_truth(est, gt, symmetry))


def box_iou(est: Box, gt: Box) -> float:
    """Intersection over union of the volumes of two oriented boxes, 0 to 1.

    Exact up to rounding; see `cadalign.geometry.clipping.intersection_volume`. Raises InputError if
    a box has no volume.

    Examples
    --------
    >>> gt = Box([0, 0, 0], np.eye(3), [2, 2, 2])
    >>> round(box_iou(est=Box([1, 0, 0], np.eye(3), [2, 2, 2]), gt=gt), 12)
    0.333333333333
    """
    _check_volumes(est, gt)
    return float(box_ious(est=est, gt=gt))


def box_iou_up_to_scale(est: Box, gt: Box) -> float:
    """Largest box IoU over all scalings of the estimate about the camera centre, 0 to 1.

    One image determines size and distance only up to a common factor. Unlike the IoU at equal
    distances of the centres, this metric is symmetric in estimate and truth, and a wrong length
    along the line of sight costs no more than it must.

    The maximum is global, to 1e-6. For boxes s E and G that intersect, the cube root of the
    intersection's volume is concave in s (Brunn-Minkowski; the pairs of s and a point of s E form a
    convex cone), and the cube root of the sum of the volumes is convex. The IoU increases with the
    ratio of the two, which has no local maximum but the global one. A linear program gives the
    range of s, a bounded scalar search the maximum. Raises InputError as `box_iou` does.

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

    # The maximum of a perfect estimate is a kink, which the search only approximates.
    likely = [np.cbrt(gt.volume / est.volume)]
    if est.center.any() and gt.center.any():
        likely.append(np.linalg.norm(gt.center) / np.linalg.norm(est.center))
    losses = [loss(float(np.log(factor))) for factor in likely]
    bounds = float(np.log(low)), float(np.log(high))
    search = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    return -min(float(search.fun), *losses)


def _check_volumes(est: Box, gt: Box) -> None:
    for name, box in (("est", est), ("gt", gt)):
        if not have_volume(box):
            what, fix = f"the box {box.extents.tolist()} has no volume", "leave flat models out"
            raise InputError(what, where=name, fix=f"{fix} of volume metrics")


def _common_factors(est: Box, gt: Box) -> tuple[float, float] | None:
    """Range of the factors at which the scaled estimate intersects the truth; None if empty.

    Factors that make one volume more than 1e9 times the other are ignored.
    """
    from scipy.optimize import linprog

    equal = float(np.cbrt(gt.volume / est.volume))
    unit = float(gt.extents.max())
    # Points x [units], factors s [of equal volumes]: |E' (x - s c)| <= s h, |G' (x - d)| <= k.
    scaled = equal / unit
    offset, half = scaled * (est.rotation.T @ est.center), scaled * est.extents / 2
    fixed, reach = gt.rotation.T @ gt.center / unit, gt.extents / (2 * unit)
    factors = np.concatenate([-offset - half, offset - half, np.zeros(6)])
    places = [est.rotation.T, -est.rotation.T, gt.rotation.T, -gt.rotation.T]
    rows = np.column_stack([factors, np.concatenate(places)])
    limits = np.concatenate([np.zeros(6), reach + fixed, reach - fixed])
    bounds = [(1e-3, 1e3), (None, None), (None, None), (None, None)]
    ends = []
    for sign in (1.0, -1.0):
        found = linprog([sign, 0.0, 0.0, 0.0], A_ub=rows, b_ub=limits, bounds=bounds)
        if not found.success:
            return None
        ends.append(equal * float(found.x[0]))
    return (ends[0], ends[1]) if ends[0] < ends[1] else None


# Stacks ------------------------------------------------------------------------------------------


def rotation_errors(*, est: _Poses, gt: _Poses) -> FloatArray:
    """Angles (...) [degrees]; see `rotation_error`."""
    return angles_between(est.rotation, gt.rotation)


def translation_errors(*, est: _Poses, gt: _Poses) -> FloatArray:
    """Distances (...) [model units]; see `translation_error`."""
    return lengths(est.translation - gt.translation)


def translation_errors_up_to_scale(*, est: _Poses, gt: _Poses) -> FloatArray:
    """Distances (...); see `translation_error_up_to_scale`."""
    squares = dots(est.translation, est.translation)
    products = dots(est.translation, gt.translation)
    factors = np.divide(products, squares, out=np.zeros_like(squares), where=squares > 0)
    return lengths(np.maximum(factors, 0.0)[..., None] * est.translation - gt.translation)


def scale_errors(*, est: _Poses, gt: _Poses) -> FloatArray:
    """Relative errors (..., 3) along each axis; see `scale_error`."""
    return np.asarray(np.abs(est.scale - gt.scale) / gt.scale)


def have_volume(boxes: _Boxes) -> BoolArray:
    """Mask (...) of the boxes with a volume."""
    extents = boxes.extents
    return np.asarray(extents.min(axis=-1) > _LEAST_SIDE * extents.max(axis=-1))


def box_ious(*, est: _Boxes, gt: _Boxes) -> FloatArray:
    """Intersections over unions (...) of boxes with a volume; see `box_iou`."""
    from cadalign.geometry.clipping import intersection_volume  # compiles; not on import

    # Relative to the boxes' size, no product under- or overflows.
    unit = np.maximum(est.extents.max(axis=-1), gt.extents.max(axis=-1))
    to_est = est.rotation.swapaxes(-1, -2)
    centers = (to_est @ (gt.center - est.center)[..., None])[..., 0] / unit[..., None]
    sides, gt_sides = est.extents / unit[..., None], gt.extents / unit[..., None]
    turns = (to_est @ gt.rotation).reshape(-1, 3, 3)
    vectors = (each.reshape(-1, 3) for each in (sides, gt_sides, centers))
    pairs = ((a, b, turn, c) for a, b, c, turn in zip(*vectors, turns, strict=True))
    shared = np.reshape([intersection_volume(*pair) for pair in pairs], unit.shape)
    # Python's power, since NumPy rounds powers of arrays and of numbers differently.
    cubes = np.reshape([side**3 for side in unit.ravel().tolist()], unit.shape)
    total = (est.extents.prod(axis=-1) + gt.extents.prod(axis=-1)) / cubes
    return np.asarray(np.clip(shared / (total - shared), 0.0, 1.0))
