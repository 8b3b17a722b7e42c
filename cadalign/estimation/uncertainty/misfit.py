"""Tests of residuals, and of given scales and camera, against stated noise; outliers among them."""

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
from cadalign.estimation.uncertainty.posterior import FittedKeypoints, Likelihood
from cadalign.estimation.uncertainty.residuals import chi_square_tail
from cadalign.estimation.uncertainty.summary import Misfit, percent, uncertainty_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.projection import predicted_covariances, projection_jacobian

_FALSE_OUTLIERS = 0.01
Rows = npt.NDArray[np.intp]
_FALSE_ALARMS = 0.004
_FALSE_STRETCH_ALARMS = 0.002
_FALSE_CAMERA_ALARMS = 1e-5
_SCALES = 2  # unknown ones, of an alignment without constraints
_WORTH_A_SEARCH = 4.0  # linearised decrease of the sum
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


@dataclass(frozen=True)
class NoiseLevel:
    """Prior on the keypoints' noise, relative to that of the fits."""

    sigma: float = 1.0  # expected standard deviation
    equations: float = math.inf  # weight, as of so many equations; infinite for a known noise

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
            quantile = _f_quantile(_FALSE_OUTLIERS / count, redundancy + self.level.equations)
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
        others = others[result.camera.sees(result.alignment.apply(self.points_3d[others]))]
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
    except (InputError, np.linalg.LinAlgError):  # a depth, or a weight, that rounds to zero
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


@dataclass(frozen=True, eq=False)
class Tested:
    """A result's inliers, with their noise and the sum of their losses."""

    points_3d: FloatArray
    points_2d: FloatArray
    covariances: FloatArray
    rows: IntArray
    alignment: Alignment
    camera: Camera
    options: FitOptions
    chi_square: float

    @classmethod
    def of(cls, result: FittedKeypoints) -> Tested:
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
            result.alignment,
            result.camera,
            result.options,
            float(likelihood.losses(residuals).sum()),
        )

    @property
    def redundancy(self) -> int:
        """Equations, of the priors too, minus unknowns.

        A scale that the keypoints leave to the bounding prior has its equation there.
        """
        priors = int(self.options.focal_prior is not None)
        width = self.options.scale_prior.width
        if width == 0:
            priors += len(self.options.stretched_axes)
        else:
            priors += int((np.abs(np.log(self.alignment.scale)) > width).sum())
        return 2 * len(self.rows) - self.options.unknowns + priors

    @property
    def passes(self) -> bool:
        """True if the noise explains the sum."""
        redundancy = self.redundancy
        return redundancy <= 0 or chi_square_tail(self.chi_square, redundancy) >= _FALSE_ALARMS

    def decrease_by_focal(self) -> float:
        """Decrease of the sum by a focal length of its own, to first order."""
        derivatives = projection_jacobian(self.points_3d, self.camera, self.alignment)
        free = [*self.options.estimated_unknowns, 9]
        whitening = np.linalg.inv(np.linalg.cholesky(self.covariances))
        rows = (whitening @ derivatives[:, :, free]).reshape(2 * len(self.rows), -1)
        projected = self.camera.project(self.alignment.apply(self.points_3d))
        errors = (whitening @ (projected - self.points_2d)[:, :, None]).ravel()
        others, _ = np.linalg.qr(rows[:, :-1])
        alone = rows[:, -1] - others @ (others.T @ rows[:, -1])
        length, along = float(alone @ alone), float(alone @ errors)
        return along * (along / length) if length > 0 else 0.0  # a power raises where it overflows

    def fit(
        self,
        rows: Rows | slice = slice(None),
        *,
        camera: Camera | None = None,
        **changes: Any,
    ) -> FittedKeypoints:
        """Fit some of the keypoints anew, with changed options or camera."""
        options = replace(self.options, sigma=self.covariances[rows], **changes)
        chosen = self.camera if camera is None else camera
        problems = pack_one(self.points_3d[rows], self.points_2d[rows], chosen)
        with np.errstate(all="ignore"):
            solutions = solve_one(problems, options)
        return FittedKeypoints(**fitted_fields(problems, solutions, options))


def contradicting_scale(tested: Tested) -> tuple[float, float, float] | None:
    """The scales without the constraints on them, if these contradict the keypoints."""
    options = tested.options
    if len(options.stretched_axes) == _SCALES and options.stretch_sigma is None:
        return None
    try:
        free = tested.fit(stretch=None, stretch_sigma=None)
        decrease = tested.chi_square - Tested.of(free).chi_square
    except CadalignError:  # the keypoints do not determine the scales, so nothing contradicts
        return None
    if chi_square_tail(decrease, _SCALES) >= _FALSE_STRETCH_ALARMS:
        return None
    x, y, z = free.alignment.scale.tolist()
    return x, y, z


def contradicting_camera(tested: Tested) -> Camera | None:
    """The camera that the keypoints fit instead of the given one, if they contradict it.

    Tried are a focal length of their own and images of another size than the camera's, unless the
    keypoints fit and the derivative by the focal length promises nothing.
    """
    if tested.options.focal == "estimate" or tested.redundancy < 1:
        return None
    if tested.passes and tested.decrease_by_focal() < _WORTH_A_SEARCH:
        return None
    width, height = tested.camera.width, tested.camera.height
    found = [_tried(tested, focal="estimate")]
    from cadalign.estimation.mistakes import OTHER_SIZES  # rarely asked

    for factor in OTHER_SIZES:
        sizes = max(1, round(width * factor)), max(1, round(height * factor))
        found.append(_tried(tested, camera=tested.camera.resized(*sizes)))
    fits = [each for each in found if each is not None and each.passes]
    if not fits:
        return None
    best = min(fits, key=lambda each: each.chi_square)
    decrease = tested.chi_square - best.chi_square
    return best.camera if chi_square_tail(decrease, 1) < _FALSE_CAMERA_ALARMS else None


def _tried(tested: Tested, **changes: Any) -> Tested | None:
    try:
        return Tested.of(tested.fit(**changes))
    except CadalignError:
        return None


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
