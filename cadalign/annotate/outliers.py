"""Outliers among the pairs, and their distances from the other pairs' prediction."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError
from cadalign.fitting.prediction import predicted_covariances, projection_jacobian
from cadalign.fitting.result import FitResult

Rows = npt.NDArray[np.intp]
FitRows = Callable[[Rows, bool], FitResult]
"""Fits some rows with a sigma of 1 px; with a robust loss if the second argument is True."""

_FALSE_ALARMS = 0.01
# Prior on the noise, with the weight of as many equations: hands click to about 2 px, and shapes
# differ by as much.
_PRIOR_SIGMA = 2.0
_PRIOR_EQUATIONS = 4


def find_outliers(
    points_3d: FloatArray, points_2d: FloatArray, fit_rows: FitRows, *, unknowns: int
) -> dict[int, float]:
    """Find the pairs that lie farther from the others' prediction than noise explains.

    A forward search (Hadi, "Identifying multiple outliers in multivariate data", 1992): it begins
    with the better half of the pairs in a robust fit and adds all that agree, until nothing
    changes, so that several outliers do not mask each other. The noise is estimated from the
    inliers, since all pairs of a model that is only similar to the object are some pixels off.

    Returns, by row, the outlier's distance [px] from the prediction of the fit to the inliers; none
    with too few pairs: without one, at least two more equations than unknowns must be left.
    """
    count = len(points_3d)
    least = unknowns // 2 + 1
    if count <= least:
        return {}
    try:
        inliers = _forward_search(points_3d, points_2d, fit_rows, least, unknowns)
        if inliers.all():
            return {}
        result = fit_rows(np.flatnonzero(inliers), False)
    except CadalignError:  # a subset of the pairs is degenerate, so that none can be judged
        return {}
    lengths = np.linalg.norm(_residuals(points_3d, points_2d, result), axis=1)
    return {int(row): float(lengths[row]) for row in np.flatnonzero(~inliers)}


def _forward_search(
    points_3d: FloatArray, points_2d: FloatArray, fit_rows: FitRows, least: int, unknowns: int
) -> BoolArray:
    """Find the inliers, (n,) bool."""
    count = len(points_3d)
    start = max(least, count // 2 + 1)
    robust = _residuals(points_3d, points_2d, fit_rows(np.arange(count), True))
    rows = np.sort(np.argsort(np.linalg.norm(robust, axis=1), kind="stable")[:start])
    for _ in range(2 * count):
        result = fit_rows(rows, False)
        residuals = _residuals(points_3d, points_2d, result)
        redundancy = 2 * len(rows) - unknowns + _PRIOR_EQUATIONS
        total = float((residuals[rows] ** 2).sum()) + _PRIOR_EQUATIONS * _PRIOR_SIGMA**2
        statistic = _statistic(points_3d, residuals, result, rows) / (total / redundancy)
        agreed = np.flatnonzero(statistic <= _f_quantile(_FALSE_ALARMS / count, redundancy))
        if len(agreed) < start:
            agreed = np.sort(np.argsort(statistic, kind="stable")[:start])
        if np.array_equal(agreed, rows):
            break
        rows = agreed
    inliers = np.zeros(count, dtype=bool)
    inliers[rows] = True
    return inliers


def _statistic(
    points_3d: FloatArray, residuals: FloatArray, result: FitResult, rows: Rows
) -> FloatArray:
    """Squared residuals (n,) per equation over their expectation at sigma = 1 px.

    For pairs outside the fit, the covariance of the prediction adds to the noise.
    """
    expected = np.tile(np.eye(2), (len(points_3d), 1, 1))
    others = np.setdiff1d(np.arange(len(points_3d)), rows)
    others = others[result.alignment.apply(points_3d[others])[:, 2] > 0]
    if len(others) and result.covariance is not None:
        jacobian = projection_jacobian(
            points_3d[others],
            result.camera,
            result.alignment,
            known_axis=result.known_axis,
            unknowns=len(result.covariance),
        )
        expected[others] += predicted_covariances(jacobian, result.covariance)
    finite = np.nan_to_num(residuals, posinf=1e9)
    squares = np.einsum("na,nab,nb->n", finite, np.linalg.inv(expected), finite) / 2
    return np.asarray(squares)


def _residuals(points_3d: FloatArray, points_2d: FloatArray, result: FitResult) -> FloatArray:
    """Projected minus observed (n, 2) [px]; infinite behind the camera."""
    in_camera = result.alignment.apply(points_3d)
    ahead = in_camera[:, 2] > 0
    residuals = np.full((len(points_3d), 2), np.inf)
    residuals[ahead] = result.camera.project(in_camera[ahead]) - points_2d[ahead]
    return residuals


def _f_quantile(chance: float, equations: int) -> float:
    """Value that an F variable with (2, equations) degrees of freedom exceeds by this chance."""
    return equations / 2 * (math.pow(chance, -2 / equations) - 1)
