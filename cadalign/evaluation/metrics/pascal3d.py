"""PASCAL3D+'s viewpoint metrics: accuracy at pi/6 and the median error.

Tulsiani, Malik, "Viewpoints and Keypoints", CVPR 2015, section 4.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.arrays import as_floats
from cadalign.errors import InputError
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.sets import MetricSet, Rate, numbers
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import rotation_error
from cadalign.geometry.symmetry import symmetric_rotation_error

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTarget
    from cadalign.evaluation.runs.tables import Row

ACCURACY_DEG = 30.0
"""pi/6 [degrees]."""


@dataclass(frozen=True)
class ViewpointScores:
    """Scores by category, and their means over categories.

    Parameters
    ----------
    accuracy : dict
        Share of the objects whose error is below pi/6.
    median_deg : dict
        Median error [degrees].
    """

    accuracy: dict[str, float]
    median_deg: dict[str, float]

    @property
    def mean_accuracy(self) -> float:
        """The mean of the categories' accuracies; NaN without any."""
        return _mean(self.accuracy)

    @property
    def mean_median_deg(self) -> float:
        """The mean of the categories' median errors [degrees]; NaN without any."""
        return _mean(self.median_deg)


def viewpoint_error_deg(*, est: npt.ArrayLike, gt: npt.ArrayLike) -> float:
    """Geodesic distance |log(R_est' R_gt)| / sqrt(2) of two rotations (3, 3) [degrees].

    Raises
    ------
    InputError
        If one is not a rotation.

    Examples
    --------
    >>> round(viewpoint_error_deg(est=np.diag([-1, -1, 1]), gt=np.eye(3)), 9)
    180.0
    """
    poses = [Alignment(np.asarray(each), np.zeros(3), np.ones(3)) for each in (est, gt)]
    return rotation_error(est=poses[0], gt=poses[1])


def viewpoint_scores(errors_deg: Mapping[str, Sequence[float]]) -> ViewpointScores:
    """Scores of the errors of each category; categories without any are left out.

    Raises
    ------
    InputError
        If an error is negative or not finite.

    Examples
    --------
    >>> viewpoint_scores({"car": [3, 10, 170], "bus": [29.9, 30.1]}).accuracy["bus"]
    0.5
    """
    accuracy, median = {}, {}
    for category, values in errors_deg.items():
        errors = as_floats(values, name=f"errors_deg[{category!r}]", shape=(None,))
        if (errors < 0).any():
            raise InputError("an error is negative", where=f"errors_deg[{category!r}]")
        if len(errors):
            accuracy[category] = float((errors < ACCURACY_DEG).mean())
            median[category] = float(np.median(errors))
    return ViewpointScores(accuracy, median)


def _mean(values: Mapping[str, float]) -> float:
    return float(np.mean(list(values.values()))) if values else float("nan")


ROTATION = replace(metrics.ROTATION, digits=2)
ACCURACY = metrics.rate("accuracy_pi_6", "accuracy at pi/6", "Acc pi/6")


def _measure(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    error = symmetric_rotation_error(est=est, gt=gt, symmetry=target.found.symmetry)
    return {ROTATION.key: error}


VIEWPOINT = MetricSet(
    "viewpoint",
    _measure,
    columns=(ROTATION.key,),
    medians=(ROTATION,),
    rates=(Rate(ACCURACY, ROTATION, lambda cells: numbers(cells, ROTATION) < ACCURACY_DEG),),
    headline=(ROTATION, ACCURACY),
    console=(ROTATION, ACCURACY),
)
