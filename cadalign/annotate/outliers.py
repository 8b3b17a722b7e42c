"""The few keypoints that contradict the others: a forward search."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.estimation.result import Result
from cadalign.geometry.camera import predicted_covariances, projection_jacobian

_FALSE_OUTLIERS = 0.01
_MOST_ROUNDS = 100  # of a forward search, each of which fits all inliers
# Hands click to about 2 px, and shapes differ by as much: weight of that, as of so many equations.
_CLICK, _CLICK_EQUATIONS = 2.0, 4

Rows = npt.NDArray[np.intp]
FitRows = Callable[[Rows, bool], Result]
"""A fit of some rows at a noise of 1 px; with a robust loss if the second argument is True."""


def find_outliers(
    points_3d: FloatArray, points_2d: FloatArray, fit_rows: FitRows, *, unknowns: int
) -> dict[int, float]:
    """Find the keypoints that lie farther from the others' prediction than noise explains.

    A forward search (Hadi, "Identifying multiple outliers in multivariate data", 1992): it begins
    with the better half of the keypoints in a robust fit and adds all that agree, until nothing
    changes, so that several outliers do not mask each other. The noise is estimated from the
    inliers, about that of clicks, since all keypoints of a model that is only similar to the object
    are some pixels off.

    Returns, by row, the outlier's distance [px] from the prediction of the fit to the inliers; none
    with too few keypoints: without one, at least two more equations than unknowns must be left.
    """
    count, least = len(points_3d), unknowns // 2 + 1
    if count <= least:
        return {}
    start = max(least, count // 2 + 1)

    def residuals_of(result: Result) -> FloatArray:
        """Projected minus observed (n, 2) [px]; infinite behind the camera."""
        in_camera = result.alignment.apply(points_3d)
        return result.camera.project_where_ahead(in_camera) - points_2d

    def statistic(rows: Rows) -> tuple[FloatArray, float]:
        """Squared residuals (n,) per equation over their expectation, and their quantile.

        For keypoints outside the fit, the covariance of the prediction adds to the noise.
        """
        result = fit_rows(rows, False)
        residuals, covariance = residuals_of(result), result.fisher_covariance
        equations = 2 * len(rows) - unknowns + _CLICK_EQUATIONS
        total = float((residuals[rows] ** 2).sum()) + _CLICK_EQUATIONS * _CLICK**2
        expected = np.tile(np.eye(2), (count, 1, 1))
        others = np.setdiff1d(np.arange(count), rows)
        others = others[result.camera.sees(result.alignment.apply(points_3d[others]))]
        if len(others) and covariance is not None:
            jacobian = projection_jacobian(points_3d[others], result.camera, result.alignment)
            expected[others] += predicted_covariances(jacobian, covariance)
        finite = np.nan_to_num(residuals, posinf=1e9)
        squares = np.einsum("na,nab,nb->n", finite, np.linalg.inv(expected), finite)
        # The quantile of an F distribution with 2 degrees of freedom has a closed form.
        quantile = equations / 2 * (math.pow(_FALSE_OUTLIERS / count, -2 / equations) - 1)
        return np.asarray(squares / 2 / (total / equations)), quantile

    def nearest(values: FloatArray) -> Rows:
        return np.sort(np.argsort(values, kind="stable")[:start])

    try:
        robust = residuals_of(fit_rows(np.arange(count), True))
        rows, known = nearest((robust**2).sum(axis=1)), set[bytes]()
        # The search may come back to a set instead of coming to rest.
        while rows.tobytes() not in known and len(known) < _MOST_ROUNDS:
            known.add(rows.tobytes())
            values, quantile = statistic(rows)
            agreed = np.flatnonzero(values <= quantile)
            rows = agreed if len(agreed) >= start else nearest(values)
        outliers = np.setdiff1d(np.arange(count), rows)
        if not len(outliers):
            return {}
        lengths = np.linalg.norm(residuals_of(fit_rows(rows, False)), axis=1)
    except CadalignError:  # a subset of the keypoints is degenerate, so that none can be judged
        return {}
    return {int(row): float(lengths[row]) for row in outliers}
