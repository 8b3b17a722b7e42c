"""Outliers: the keypoints that lie farther from the others' prediction than noise explains."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.projection import predicted_covariances, projection_jacobian

_FALSE_ALARMS = 0.01
Rows = npt.NDArray[np.intp]


class PoseFit(Protocol):
    """A fit of keypoints, such as `cadalign.Result`."""

    @property
    def alignment(self) -> Alignment: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def fisher_covariance(self) -> FloatArray | None: ...


FitRows = Callable[[Rows, bool], PoseFit]
"""Fits some rows at the noise of `find_outliers`; with a robust loss if the second argument is
True."""


@dataclass(frozen=True)
class NoiseLevel:
    """Prior on the keypoints' noise, relative to that of the fits.

    Parameters
    ----------
    sigma : float
        Expected standard deviation.
    equations : float
        Weight of the prior, as that of so many equations; infinite for a known noise.
    """

    sigma: float = 1.0
    equations: float = math.inf

    def variance(self, squares: float, redundancy: float) -> float:
        """The variance, by the prior and a sum of squares with that redundancy."""
        if math.isinf(self.equations):
            return self.sigma**2
        return (squares + self.equations * self.sigma**2) / (redundancy + self.equations)


CLICKS = NoiseLevel(2.0, 4)
"""Hands click to about 2 px, and shapes differ by as much."""


def find_outliers(
    points_3d: FloatArray,
    points_2d: FloatArray,
    fit_rows: FitRows,
    *,
    unknowns: int,
    noise: FloatArray | None = None,
    level: NoiseLevel = CLICKS,
) -> dict[int, float]:
    """Find the keypoints that lie farther from the others' prediction than noise explains.

    A forward search (Hadi, "Identifying multiple outliers in multivariate data", 1992): it begins
    with the better half of the keypoints in a robust fit and adds all that agree, until nothing
    changes, so that several outliers do not mask each other. ``noise`` (n, 2, 2) are the
    covariances [px^2] of the fits, by default those of 1 px; unless ``level`` says that it is
    known, their common factor is estimated from the inliers, since all keypoints of a model that is
    only similar to the object are some pixels off.

    Returns, by row, the outlier's distance [px] from the prediction of the fit to the inliers; none
    with too few keypoints: without one, at least two more equations than unknowns must be left.
    """
    count = len(points_3d)
    least = unknowns // 2 + 1
    if count <= least:
        return {}
    if noise is None:
        noise = np.tile(np.eye(2), (count, 1, 1))
    search = _Search(points_3d, points_2d, noise, fit_rows, level, unknowns)
    try:
        inliers = search.run(least)
        if inliers.all():
            return {}
        result = fit_rows(np.flatnonzero(inliers), False)
    except CadalignError:  # a subset of the keypoints is degenerate, so that none can be judged
        return {}
    lengths = np.linalg.norm(search.residuals(result), axis=1)
    return {int(row): float(lengths[row]) for row in np.flatnonzero(~inliers)}


@dataclass(frozen=True, eq=False)
class _Search:
    """The forward search of `find_outliers`."""

    points_3d: FloatArray
    points_2d: FloatArray
    noise: FloatArray
    fit_rows: FitRows
    level: NoiseLevel
    unknowns: int

    def run(self, least: int) -> BoolArray:
        """Find the inliers, (n,) bool, at least so many."""
        count = len(self.points_3d)
        start = max(least, count // 2 + 1)
        robust = self.residuals(self.fit_rows(np.arange(count), True))
        lengths = _squares(robust, self.noise)
        rows = np.sort(np.argsort(lengths, kind="stable")[:start])
        for _ in range(2 * count):
            statistic, redundancy = self._statistic(rows)
            quantile = _f_quantile(_FALSE_ALARMS / count, redundancy + self.level.equations)
            agreed = np.flatnonzero(statistic <= quantile)
            if len(agreed) < start:
                agreed = np.sort(np.argsort(statistic, kind="stable")[:start])
            if np.array_equal(agreed, rows):
                break
            rows = agreed
        inliers = np.zeros(count, dtype=bool)
        inliers[rows] = True
        return inliers

    def _statistic(self, rows: Rows) -> tuple[FloatArray, int]:
        """Squared residuals (n,) per equation over their expectation, and the fit's redundancy.

        For keypoints outside the fit, the covariance of the prediction adds to the noise.
        """
        result = self.fit_rows(rows, False)
        residuals = self.residuals(result)
        redundancy = 2 * len(rows) - self.unknowns
        total = float(_squares(residuals[rows], self.noise[rows]).sum())
        expected = self.noise.copy()
        others = np.setdiff1d(np.arange(len(self.points_3d)), rows)
        others = others[result.alignment.apply(self.points_3d[others])[:, 2] > 0]
        covariance = result.fisher_covariance
        if len(others) and covariance is not None:
            jacobian = projection_jacobian(self.points_3d[others], result.camera, result.alignment)
            expected[others] += predicted_covariances(jacobian, covariance)
        squares = _squares(residuals, expected) / 2
        return squares / self.level.variance(total, redundancy), redundancy

    def residuals(self, result: PoseFit) -> FloatArray:
        """Projected minus observed (n, 2) [px]; infinite behind the camera."""
        in_camera = result.alignment.apply(self.points_3d)
        return result.camera.project_where_ahead(in_camera) - self.points_2d


def _squares(residuals: FloatArray, covariances: FloatArray) -> FloatArray:
    """Squared lengths (n,) of residuals (n, 2) whitened by their covariances (n, 2, 2)."""
    finite = np.nan_to_num(residuals, posinf=1e9)
    squares = np.einsum("na,nab,nb->n", finite, np.linalg.inv(covariances), finite)
    return np.asarray(squares)


def _f_quantile(chance: float, equations: float) -> float:
    """Value that an F variable with (2, equations) degrees of freedom exceeds by this chance."""
    if math.isinf(equations):
        return -math.log(chance)
    return equations / 2 * (math.pow(chance, -2 / equations) - 1)
