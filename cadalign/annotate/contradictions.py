"""Pairs that contradict the others: which, and how far they are off."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError
from cadalign.fitting.prediction import predicted_covariances, projection_jacobian
from cadalign.fitting.result import FitResult
from cadalign.geometry.camera import Camera

Rows = npt.NDArray[np.intp]
FitRows = Callable[[Rows, bool], tuple[FitResult, Camera]]
"""Fits to some rows with a sigma of 1 px, robustly if asked to; gives result and camera."""

_FALSE_ALARMS = 0.01
# Hands click to about 2 px, and shapes differ by as much: what is thought of the noise before there
# are residuals, worth as many equations as this.
_PRIOR_SIGMA = 2.0
_PRIOR_EQUATIONS = 4


def find_contradictions(
    points_3d: FloatArray, points_2d: FloatArray, fit_rows: FitRows, *, unknowns: int
) -> dict[int, float]:
    """Find the pairs that lie farther from where the others put them than noise explains.

    A forward search (Hadi, "Identifying multiple outliers in multivariate data", 1992): it begins
    with the better half of the pairs in a robust fit, and takes in all that agree, until nothing
    changes, so that several wrong pairs do not hide each other. The noise is estimated from the
    pairs taken in: of a model that is only similar to the object, all are some pixels off.

    Parameters
    ----------
    points_3d : (n, 3) float
    points_2d : (n, 2) float
        [px]
    fit_rows : callable
    unknowns : int
        How many unknowns a fit has.

    Returns
    -------
    dict of int to float
        By row, how far the pair is from where the fit to the others puts it [px]. Empty where
        there are too few pairs to tell: at least two more equations than unknowns are needed once
        one pair is left out.
    """
    count = len(points_3d)
    least = unknowns // 2 + 1
    if count <= least:
        return {}
    try:
        agreed = _forward_search(points_3d, points_2d, fit_rows, least, unknowns)
        if agreed.all():
            return {}
        lengths = np.linalg.norm(
            _residuals(points_3d, points_2d, *fit_rows(np.flatnonzero(agreed), False)), axis=1
        )
    except CadalignError:  # some of the pairs alone determine nothing, so nothing contradicts them
        return {}
    return {int(row): float(lengths[row]) for row in np.flatnonzero(~agreed)}


def _forward_search(
    points_3d: FloatArray, points_2d: FloatArray, fit_rows: FitRows, least: int, unknowns: int
) -> BoolArray:
    """Which rows agree with each other, (n,) bool."""
    count = len(points_3d)
    start = max(least, count // 2 + 1)
    robust = _residuals(points_3d, points_2d, *fit_rows(np.arange(count), True))
    rows = np.sort(np.argsort(np.linalg.norm(robust, axis=1), kind="stable")[:start])
    for _ in range(2 * count):
        result, camera = fit_rows(rows, False)
        residuals = _residuals(points_3d, points_2d, result, camera)
        redundancy = 2 * len(rows) - unknowns + _PRIOR_EQUATIONS
        total = float((residuals[rows] ** 2).sum()) + _PRIOR_EQUATIONS * _PRIOR_SIGMA**2
        statistic = _statistic(points_3d, residuals, result, camera, rows) / (total / redundancy)
        agreed = np.flatnonzero(statistic <= _limit(_FALSE_ALARMS / count, redundancy))
        if len(agreed) < start:
            agreed = np.sort(np.argsort(statistic, kind="stable")[:start])
        if np.array_equal(agreed, rows):
            break
        rows = agreed
    kept = np.zeros(count, dtype=bool)
    kept[rows] = True
    return kept


def _statistic(
    points_3d: FloatArray, residuals: FloatArray, result: FitResult, camera: Camera, rows: Rows
) -> FloatArray:
    """Squared residuals (n,) per equation over what they are expected to be at sigma = 1 px.

    Where the fit has not seen a pair, the uncertainty of its prediction adds to the noise.
    """
    expected = np.tile(np.eye(2), (len(points_3d), 1, 1))
    others = np.setdiff1d(np.arange(len(points_3d)), rows)
    others = others[result.alignment.apply(points_3d[others])[:, 2] > 0]
    if len(others) and result.covariance is not None:
        jacobian = projection_jacobian(
            points_3d[others], camera, result.alignment, unknowns=len(result.covariance)
        )
        expected[others] += predicted_covariances(jacobian, result.covariance)
    finite = np.nan_to_num(residuals, posinf=1e9)
    squares = np.einsum("na,nab,nb->n", finite, np.linalg.inv(expected), finite) / 2
    return np.asarray(squares)


def _residuals(
    points_3d: FloatArray, points_2d: FloatArray, result: FitResult, camera: Camera
) -> FloatArray:
    """Projected minus observed (n, 2) [px]; infinite behind the camera."""
    in_camera = result.alignment.apply(points_3d)
    ahead = in_camera[:, 2] > 0
    residuals = np.full((len(points_3d), 2), np.inf)
    residuals[ahead] = camera.project(in_camera[ahead]) - points_2d[ahead]
    return residuals


def _limit(chance: float, equations: int) -> float:
    """What an F variable with (2, equations) degrees of freedom exceeds with this chance."""
    return equations / 2 * (math.pow(chance, -2 / equations) - 1)
