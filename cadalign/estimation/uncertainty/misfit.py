"""Test of the residuals against the keypoints' standard deviations, and the outliers that fail it.

An outlier is far from where the other keypoints predict it, by the covariance of the prediction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.options import FitOptions
from cadalign.estimation.uncertainty.posterior import FittedKeypoints
from cadalign.estimation.uncertainty.prediction import predicted_covariances, projection_jacobian
from cadalign.estimation.uncertainty.summary import Misfit, percent, uncertainty_of
from cadalign.estimation.uncertainty.tested import (
    Rows,
    Tested,
    contradicting_camera,
    contradicting_scale,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

_TESTED_TO = 0.1  # relative standard deviation to which a held scale must be tested
_MOST_OUTLIERS = 1 / 3  # of the keypoints; more are no outliers


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

_FALSE_OUTLIER_ALARMS = 0.01


def find_misfit(result: FittedKeypoints) -> Misfit | None:
    """Test the residuals of the inliers by chi-square; None if they pass, or sigma is estimated.

    The sum of squares at the optimum has the redundancy as its expectation; a robust loss, which is
    at most the square, only makes the test more cautious, and so does the cut of RANSAC. Priors
    count as equations that are always met. A constraint on the scales is tested by the decrease of
    the sum without it, which has one degree of freedom for each scale, and so is the camera's focal
    length.
    """
    if result.options.sigma is None:
        return None
    try:
        tested = Tested.of(result)
    except InputError:  # a depth that rounds to zero has no projection
        return None
    free_scale = contradicting_scale(tested)
    if free_scale is not None:
        return Misfit(tested.chi_square, tested.redundancy, free_scale)
    passes = tested.passes
    outliers = {} if passes else _outliers(tested)
    camera = contradicting_camera(tested) if len(outliers) != 1 else None
    if camera is not None:
        return Misfit(tested.chi_square, tested.redundancy, camera=camera)
    return None if passes else Misfit(tested.chi_square, tested.redundancy, outliers=outliers)


def unverified_stretch(result: FittedKeypoints) -> str | None:
    """Warn about scales held at 1 where the keypoints would not contradict another value.

    None where nothing is held, sigma is estimated, or the free scales are not determined at all,
    which is what holding them is for.
    """
    options = result.options
    held = set("xyz") - {options.known_axis} - set(options.stretched_axes)
    if not held or options.sigma is None:
        return None
    try:
        free = Tested.of(result).fit(stretch=None)
    except CadalignError:
        return None
    assert free.fisher_covariance is not None
    scale = uncertainty_of(free.fisher_covariance).scale
    doubtful = [axis for axis in sorted(held) if scale["xyz".index(axis)] > _TESTED_TO]
    if not doubtful:
        return None
    known = " and ".join(f"s_{axis} to +-{percent(scale['xyz'.index(axis)])}" for axis in doubtful)
    return (
        f"the scale is held at 1, which is not tested: free, the keypoints determine {known} only"
    )


def _outliers(tested: Tested) -> dict[int, float]:
    """The few keypoints without which the others pass the test, with their distances [px]."""

    def fit_rows(rows: Rows, robust: bool) -> FittedKeypoints:
        loss = "cauchy" if robust else "linear"
        return tested.fit(rows, loss=loss, loss_scale=FitOptions.loss_scale)

    found = find_outliers(
        tested.points_3d,
        tested.points_2d,
        fit_rows,
        unknowns=tested.options.unknowns,
        noise=tested.covariances,
        level=NoiseLevel(),
    )
    if not 0 < len(found) <= _MOST_OUTLIERS * len(tested.rows):
        return {}
    rest = fit_rows(np.setdiff1d(np.arange(len(tested.rows)), list(found)), False)
    if not Tested.of(rest).passes:
        return {}
    return {int(tested.rows[row]): length for row, length in found.items()}


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
            quantile = _f_quantile(_FALSE_OUTLIER_ALARMS / count, redundancy + self.level.equations)
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
