"""Metrics of boxes with nine degrees of freedom: IoU at 25, 50 and 75 %, and degrees and cm.

Wang et al., "Normalized Object Coordinate Space for Category-Level 6D Object Pose and Size
Estimation" (NOCS), CVPR 2019, section 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, as_floats
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.errors import overlap_up_to_scale
from cadalign.evaluation.metrics.sets import MetricSet, Rate, numbers
from cadalign.evaluation.metrics.table import Metric
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import box_iou
from cadalign.geometry.symmetry import Symmetry, symmetric_rotation_error

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTarget
    from cadalign.evaluation.runs.opened import Cells
    from cadalign.evaluation.runs.tables import Row

IOU_THRESHOLDS = (0.25, 0.5, 0.75)
DEGREE_CM = ((5.0, 2.0), (5.0, 5.0), (10.0, 2.0), (10.0, 5.0), (10.0, 10.0))
"""Thresholds [degrees, cm]."""
# NOCS tries 20 rotations about an axis of symmetry.
_MAX_STEP = np.pi / 20


def nine_dof_iou(*, est: Box, gt: Box, symmetry: Symmetry) -> float:
    """Largest IoU of the true box and the estimated one over the object's symmetries.

    As in NOCS, the estimate is turned about its own centre by the symmetries' rotations, those
    about an axis in 20 steps.

    Parameters
    ----------
    est, gt : Box
        Boxes whose axes are the model's.
    symmetry : Symmetry

    Raises
    ------
    InputError
        If a box has no volume.
    """
    rotations = symmetry.poses(max_step=_MAX_STEP)[:, :3, :3]
    return max(
        box_iou(est=Box(est.center, est.rotation @ turn, est.extents), gt=gt) for turn in rotations
    )


def degree_cm(
    *, est: Alignment, gt: Alignment, symmetry: Symmetry, metres: float
) -> tuple[float, float]:
    """Rotation error [degrees], symmetry-aware, and translation error [cm].

    Parameters
    ----------
    est, gt : Alignment
    symmetry : Symmetry
    metres : float
        Length of one unit of the camera frame [m].

    Examples
    --------
    >>> gt = Alignment(np.eye(3), [0, 0, 1000], [1, 1, 1])
    >>> est = Alignment(np.eye(3), [0, 30, 1040], [1, 1, 1])
    >>> degrees, cm = degree_cm(est=est, gt=gt, symmetry=Symmetry.none(), metres=0.001)
    >>> degrees, round(cm, 9)
    (0.0, 5.0)
    """
    gap = float(np.linalg.norm(est.translation - gt.translation))
    degrees = symmetric_rotation_error(est=est, gt=gt, symmetry=symmetry)
    return degrees, 100 * metres * gap


def iou_shares(
    ious: npt.ArrayLike, *, thresholds: Sequence[float] = IOU_THRESHOLDS
) -> dict[float, float]:
    """Share of objects whose IoU is over each threshold; NaN without any object.

    Examples
    --------
    >>> iou_shares([0.2, 0.3, 0.6, 0.9])
    {0.25: 0.75, 0.5: 0.5, 0.75: 0.25}
    """
    values = as_floats(ious, name="ious", shape=(None,))
    return {limit: _share(values > limit) for limit in thresholds}


def degree_cm_shares(
    errors: npt.ArrayLike, *, thresholds: Sequence[tuple[float, float]] = DEGREE_CM
) -> dict[tuple[float, float], float]:
    """Share of objects within each pair of thresholds [degrees, cm]; NaN without any object.

    Parameters
    ----------
    errors : (n, 2) float
        `degree_cm` of each object.
    thresholds : sequence of (float, float)

    Examples
    --------
    >>> degree_cm_shares([(4, 1), (4, 6), (9, 4), (60, 1)], thresholds=[(5, 5), (10, 10)])
    {(5, 5): 0.25, (10, 10): 0.75}
    """
    values = as_floats(errors, name="errors", shape=(None, 2))
    return {limit: _share((values <= limit).all(axis=1)) for limit in thresholds}


def _share(found: npt.ArrayLike) -> float:
    flags = np.asarray(found, dtype=bool)
    return float(flags.mean()) if len(flags) else float("nan")


TRANSLATION = Metric("translation_cm", "translation error", "cm", symbol="t cm", limit=50.0)
_IOUS = {
    limit: metrics.rate(
        f"iou_{100 * limit:.0f}", f"IoU over {100 * limit:.0f} %", f"IoU{100 * limit:.0f}"
    )
    for limit in IOU_THRESHOLDS
}
_DEGREE_CM = {
    (deg, cm): metrics.rate(
        f"deg_{deg:.0f}_cm_{cm:.0f}",
        f"within {deg:.0f} deg, {cm:.0f} cm",
        f"{deg:.0f}deg{cm:.0f}cm",
    )
    for deg, cm in DEGREE_CM
}


def _measure(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    found, gt_box = target.found, target.gt_box
    values: Row = {}
    if found.truth.metres is not None:
        how: dict[str, Any] = {"symmetry": found.symmetry, "metres": found.truth.metres}
        values[TRANSLATION.key] = degree_cm(est=est, gt=gt, **how)[1]
    if gt_box is not None and min(box.volume, gt_box.volume) > 0:
        iou = nine_dof_iou(est=box, gt=gt_box, symmetry=found.symmetry)
        values[metrics.BOX_IOU.key] = iou
        values[metrics.BOX_IOU_UP_TO_SCALE.key] = overlap_up_to_scale(est=box, gt=gt_box)
    return values


def _is_over(cells: Cells, *, limit: float) -> BoolArray:
    return np.asarray(numbers(cells, metrics.BOX_IOU) > limit)


def _is_within(cells: Cells, *, limits: tuple[float, float]) -> BoolArray:
    rotation, translation = numbers(cells, metrics.ROTATION), numbers(cells, TRANSLATION)
    return np.asarray((rotation <= limits[0]) & (translation <= limits[1]))


NINE_DOF = MetricSet(
    "nine_dof",
    _measure,
    columns=(TRANSLATION.key, metrics.BOX_IOU.key, metrics.BOX_IOU_UP_TO_SCALE.key),
    medians=(TRANSLATION, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    rates=(
        *(
            Rate(metric, metrics.BOX_IOU, partial(_is_over, limit=limit))
            for limit, metric in _IOUS.items()
        ),
        *(
            Rate(metric, TRANSLATION, partial(_is_within, limits=limits))
            for limits, metric in _DEGREE_CM.items()
        ),
    ),
    headline=(
        *(*_IOUS.values(), TRANSLATION, *_DEGREE_CM.values()),
        *(metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    ),
    console=(TRANSLATION, _DEGREE_CM[10.0, 10.0], _IOUS[0.5]),
)
