"""Test of the residuals against the keypoints' standard deviations, and the outliers that fail it.

An outlier is far from where the other keypoints predict it, by the covariance of the prediction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.options import FitOptions
from cadalign.estimation.problems import pack_one
from cadalign.estimation.solve import fitted_fields, solve_one
from cadalign.estimation.uncertainty.distributions import chi_square_tail
from cadalign.estimation.uncertainty.posterior import FittedKeypoints, Likelihood
from cadalign.estimation.uncertainty.summary import Misfit, percent, uncertainty_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import perspective
from cadalign.solvers.projection import ray_derivatives

_FALSE_ALARMS = 0.004
_FALSE_STRETCH_ALARMS = 0.002
_TESTED_TO = 0.1  # relative standard deviation to which a held scale must be tested
_MOST_OUTLIERS = 1 / 3  # of the keypoints; more are no outliers
_SCALES = 2  # unknown ones, of an alignment without constraints
_UNKNOWNS = 10  # of a result's covariance, focal length included
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

_FALSE_OUTLIER_ALARMS = 0.01


def find_misfit(result: FittedKeypoints) -> Misfit | None:
    """Test the residuals of the inliers by chi-square; None if they pass, or sigma is estimated.

    The sum of squares at the optimum has the redundancy as its expectation; a robust loss, which is
    at most the square, only makes the test more cautious, and so does the cut of RANSAC. Priors
    count as equations that are always met. A constraint on the scales is tested by the decrease of
    the sum without it, which has one degree of freedom for each scale.
    """
    if result.options.sigma is None:
        return None
    try:
        tested = _Tested.of(result)
    except InputError:  # a depth that rounds to zero has no projection
        return None
    free_scale = _contradicting_scale(tested)
    if free_scale is not None:
        return Misfit(tested.chi_square, tested.redundancy, free_scale)
    if tested.passes:
        return None
    return Misfit(tested.chi_square, tested.redundancy, outliers=_outliers(tested))


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
        free = _Tested.of(result).fit(stretch=None)
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


@dataclass(frozen=True, eq=False)
class _Tested:
    """A result's inliers, with their noise and the sum of their losses."""

    points_3d: FloatArray
    points_2d: FloatArray
    covariances: FloatArray
    rows: IntArray
    camera: Camera
    options: FitOptions
    chi_square: float

    @classmethod
    def of(cls, result: FittedKeypoints) -> _Tested:
        rows = np.flatnonzero(result.inliers)
        points_3d, residuals = result.points_3d[rows], result.residuals[rows]
        projected = result.camera.project(result.alignment.apply(points_3d))
        likelihood = Likelihood.of(result)
        covariances = np.linalg.inv(likelihood.information)
        return cls(
            points_3d,
            projected - residuals,
            np.broadcast_to(covariances, (len(rows), 2, 2)),
            rows,
            result.camera,
            result.options,
            float(likelihood.losses(residuals).sum()),
        )

    @property
    def redundancy(self) -> int:
        """Equations, of the priors too, minus unknowns."""
        priors = int(self.options.focal_prior is not None)
        if self.options.scale_prior_sigma is not None:
            priors += len(self.options.stretched_axes)
        return 2 * len(self.rows) - self.options.unknowns + priors

    @property
    def passes(self) -> bool:
        """True if the noise explains the sum."""
        redundancy = self.redundancy
        return redundancy <= 0 or chi_square_tail(self.chi_square, redundancy) >= _FALSE_ALARMS

    def fit(self, rows: Rows | slice = slice(None), **changes: Any) -> FittedKeypoints:
        """Fit some of the keypoints anew, with changed options."""
        options = replace(self.options, sigma=self.covariances[rows], **changes)
        problems = pack_one(self.points_3d[rows], self.points_2d[rows], self.camera)
        with np.errstate(all="ignore"):
            solutions = solve_one(problems, options)
        return FittedKeypoints(**fitted_fields(problems, solutions, options))


def _contradicting_scale(tested: _Tested) -> tuple[float, float, float] | None:
    """The scales without the constraints on them, if these contradict the keypoints."""
    options = tested.options
    if len(options.stretched_axes) == _SCALES and options.scale_prior_sigma is None:
        return None
    try:
        free = tested.fit(stretch=None, scale_prior_sigma=None)
        decrease = tested.chi_square - _Tested.of(free).chi_square
    except CadalignError:  # the keypoints do not determine the scales, so nothing contradicts
        return None
    if chi_square_tail(decrease, _SCALES) >= _FALSE_STRETCH_ALARMS:
        return None
    x, y, z = free.alignment.scale.tolist()
    return x, y, z


def _outliers(tested: _Tested) -> dict[int, float]:
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
    if not _Tested.of(rest).passes:
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


def projection_jacobian(points_3d: FloatArray, camera: Camera, alignment: Alignment) -> FloatArray:
    """Derivatives (n, 2, 10) of projected points, in the order of `cadalign.Result.covariance`.

    In pixels per rad, model unit, and unit of a logarithm. Refuses points behind the camera.
    """
    in_camera = alignment.apply(points_3d)
    if not (in_camera[:, 2] > 0).all():
        raise InputError("a point lies behind the camera", where="points_3d")
    rays = perspective(in_camera)
    of_rays = np.zeros((len(rays), 2, _UNKNOWNS))
    # The kernel knows the first axis, and gives the derivatives by the scales of the other two.
    for order, last in (([0, 1, 2], [7, 8]), ([2, 0, 1], [6, 7])):
        ordered = Alignment(
            alignment.rotation[:, order],
            alignment.translation,
            alignment.scale[order],
            is_valid=True,
        )
        of_rays[:, :, [0, 1, 2, 3, 4, 5, *last]] = ray_derivatives(
            np.ascontiguousarray(points_3d[:, order], float), ordered.packed
        )
    to_pixels = np.diag([camera.fx, camera.fy]) @ camera.distortion_jacobian(rays)
    jacobian = to_pixels @ of_rays
    jacobian[:, :, 9] = camera.pixels_from_normalized(rays) - (camera.cx, camera.cy)
    return np.asarray(jacobian)


def predicted_covariances(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2) [px^2] of predicted projections, without a measurement's own noise.

    Parameters
    ----------
    jacobian : (n, 2, 10) float
        See `projection_jacobian`.
    covariance : (9, 9) or (10, 10) float
        Of the unknowns, without the focal length where that is known.
    """
    jacobian = jacobian[:, :, : len(covariance)]
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))
