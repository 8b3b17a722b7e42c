"""The few keypoints that contradict the others: a forward search."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, predicted_covariances, projection_jacobian

_FALSE_OUTLIERS = 0.01
_MOST_ROUNDS = 100  # of a forward search, each of which fits all inliers
# Hands click to about 2 px, and shapes differ by as much: weight of that, as of so many equations.
_CLICK, _CLICK_EQUATIONS = 2.0, 4

Rows = npt.NDArray[np.intp]
PlacedRows = tuple[Alignment, Camera, FloatArray | None]
FitRows = Callable[[Rows, bool], PlacedRows]
"""Alignment, camera and inverse Fisher information of a fit of some rows at the noise of
`find_outliers`; with a robust loss if the second argument is True."""


def find_outliers(
    points_3d: FloatArray,
    points_2d: FloatArray,
    fit_rows: FitRows,
    *,
    unknowns: int,
    noise: FloatArray | None = None,
) -> dict[int, float]:
    """Find the keypoints that lie farther from the others' prediction than noise explains.

    A forward search (Hadi, "Identifying multiple outliers in multivariate data", 1992): it begins
    with the better half of the keypoints in a robust fit and adds all that agree, until nothing
    changes, so that several outliers do not mask each other. ``noise`` (n, 2, 2) are the
    covariances [px^2] of the fits, which are known. Without these the fits take 1 px, and the
    common factor is estimated from the inliers, about that of clicks, since all keypoints of a
    model that is only similar to the object are some pixels off.

    Returns, by row, the outlier's distance [px] from the prediction of the fit to the inliers; none
    with too few keypoints: without one, at least two more equations than unknowns must be left.
    """
    count, least = len(points_3d), unknowns // 2 + 1
    if count <= least:
        return {}
    covariances = np.tile(np.eye(2), (count, 1, 1)) if noise is None else noise
    start = max(least, count // 2 + 1)

    def residuals_of(placed: PlacedRows) -> FloatArray:
        """Projected minus observed (n, 2) [px]; infinite behind the camera."""
        alignment, camera, _ = placed
        return camera.project_where_ahead(alignment.apply(points_3d)) - points_2d

    def statistic(rows: Rows) -> tuple[FloatArray, float]:
        """Squared residuals (n,) per equation over their expectation, and their quantile.

        For keypoints outside the fit, the covariance of the prediction adds to the noise.
        """
        placed = alignment, camera, covariance = fit_rows(rows, False)
        residuals = residuals_of(placed)
        variance, equations = 1.0, math.inf
        if noise is None:
            equations = 2 * len(rows) - unknowns + _CLICK_EQUATIONS
            total = float(_squares(residuals[rows], covariances[rows]).sum())
            variance = (total + _CLICK_EQUATIONS * _CLICK**2) / equations
        expected = covariances.copy()
        others = np.setdiff1d(np.arange(count), rows)
        others = others[camera.sees(alignment.apply(points_3d[others]))]
        if len(others) and covariance is not None:
            jacobian = projection_jacobian(points_3d[others], camera, alignment)
            expected[others] += predicted_covariances(jacobian, covariance)
        quantile = f_quantile_of_two(equations, _FALSE_OUTLIERS / count)
        return _squares(residuals, expected) / 2 / variance, quantile

    def nearest(squares: FloatArray) -> Rows:
        return np.sort(np.argsort(squares, kind="stable")[:start])

    try:
        robust = residuals_of(fit_rows(np.arange(count), True))
        rows, known = nearest(_squares(robust, covariances)), set[bytes]()
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


def _squares(residuals: FloatArray, covariances: FloatArray) -> FloatArray:
    """Squared lengths (n,) of residuals (n, 2) whitened by their covariances (n, 2, 2)."""
    finite = np.nan_to_num(residuals, posinf=1e9)
    return np.asarray(np.einsum("na,nab,nb->n", finite, np.linalg.inv(covariances), finite))


def f_quantile_of_two(second: float, probability: float) -> float:
    """`f_quantile` of 2 and some degrees of freedom in closed form; infinitely many are allowed."""
    if math.isinf(second):
        return -math.log(probability)
    return second / 2 * (math.pow(probability, -2 / second) - 1)
