"""Tests of residuals, and of given scales and camera, against stated noise: outliers, mistakes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.fitted import FittedKeypoints
from cadalign.estimation.options import FitOptions
from cadalign.estimation.problems import pack_one
from cadalign.estimation.solve import fitted_fields, solve_one
from cadalign.estimation.uncertainty.posterior import Likelihood
from cadalign.estimation.uncertainty.residuals import (
    chi_square_tail,
    f_quantile_of_two,
)
from cadalign.estimation.uncertainty.summary import percent, uncertainty_of
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, predicted_covariances, projection_jacobian

Rows = npt.NDArray[np.intp]
_FALSE_OUTLIERS = 0.01
_FALSE_ALARMS = 0.004
_FALSE_STRETCH_ALARMS = 0.002
_FALSE_CAMERA_ALARMS = 1e-5
_SCALES = 2  # unknown ones, of an alignment without constraints
_WORTH_A_SEARCH = 4.0  # linearised decrease of the sum
_TESTED_TO = 0.1  # relative standard deviation to which a held scale must be tested
_MOST_ROUNDS = 100  # of a forward search, each of which fits all inliers
_MOST_NAMED = 5  # outliers, in a sentence
_MOST_OUTLIERS = 1 / 3  # of the keypoints; more are no outliers
# Hands click to about 2 px, and shapes differ by as much: weight of that, as of so many equations.
_CLICK, _CLICK_EQUATIONS = 2.0, 4
_LARGE = 0.02  # estimated sigma, over the keypoints' extent, that is large
_LARGEST_SHARE = 0.45  # of the keypoints' spread, of an estimated sigma

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


@dataclass(frozen=True, eq=False)
class _Tested:
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

    def may_fall(self, chance: float, unknowns: int) -> bool:
        """True if so many unknowns more may lower the sum, to zero at most, beyond this chance."""
        return chi_square_tail(self.chi_square, unknowns) < chance

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
        self, rows: Rows | slice = slice(None), *, camera: Camera | None = None, **changes: Any
    ) -> FittedKeypoints:
        """Fit some of the keypoints anew, with changed options or camera."""
        options = replace(self.options, sigma=self.covariances[rows], **changes)
        chosen = self.camera if camera is None else camera
        problems = pack_one(self.points_3d[rows], self.points_2d[rows], chosen)
        with np.errstate(all="ignore"):
            solutions = solve_one(problems, options)
        return FittedKeypoints(**fitted_fields(problems, solutions, options))

    def again(self, **changes: Any) -> _Tested | None:
        """The keypoints in a fit with changed options or camera; None if there is none."""
        try:
            return _Tested.of(self.fit(**changes))
        except CadalignError:
            return None


class Misfit(NamedTuple):
    """A warning about residuals that the noise does not explain; a camera that would, if any."""

    warning: EstimateWarning
    camera: Camera | None = None

    @property
    def has_reason(self) -> bool:
        """True where a few keypoints or the stretch are to blame."""
        return self.warning.kind in ("outlier", "stretch")


def find_misfit(result: FittedKeypoints) -> Misfit | None:
    """Test the residuals of the inliers by chi-square; None if they pass, or sigma is estimated.

    The sum of squares at the optimum has the redundancy as its expectation; a robust loss, which is
    at most the square, only makes the test more cautious, and so does the cut of RANSAC. Priors
    count as equations that are always met. A constraint on the scales is tested by the decrease of
    the sum without it, which has one degree of freedom for each scale, and so is the camera's focal
    length.
    """
    if result.options.sigma is None or result.fisher_covariance is None:
        return None
    try:
        tested = _Tested.of(result)
    except (InputError, np.linalg.LinAlgError):  # a depth, or a weight, that rounds to zero
        return None
    scale = _contradicting_scale(tested)
    if scale is not None:
        listed = ", ".join(f"{value:.3g}" for value in scale)
        text = (
            "the keypoints contradict the constraint on the stretch: without it they fit better, "
            f"with the scale ({listed})"
        )
        return Misfit(EstimateWarning("stretch", text))
    passes = tested.passes
    outliers = {} if passes else _outliers(tested)
    camera = _contradicting_camera(tested) if len(outliers) != 1 else None
    if camera is not None:
        text = (
            "the keypoints contradict the camera: they fit one better that has a focal length of "
            f"{camera.fx:.4g} px and images of {camera.width} x {camera.height} px"
        )
        return Misfit(EstimateWarning("camera", text, 0), camera)
    return None if passes else Misfit(_large_residuals(tested, outliers))


def _large_residuals(tested: _Tested, outliers: Mapping[int, float]) -> EstimateWarning:
    """The warning about residuals; ``outliers`` are rows with their distances [px]."""
    ratio = math.sqrt(tested.chi_square / tested.redundancy)
    text = f"the residuals are {ratio:.2g} times as large as sigma explains: "
    if not outliers:
        text += (
            "the keypoints do not fit the model together (wrong pairs, model, stretch or camera), "
            "or sigma is too small; sigma=None suits a model that is only similar"
        )
        return EstimateWarning("misfit", text)
    worst = sorted(outliers, key=lambda row: -outliers[row])[:_MOST_NAMED]
    named = ", ".join(f"{row} ({outliers[row]:.3g} px)" for row in worst)
    if len(worst) < len(outliers):
        named += f" and {len(outliers) - len(worst)} more"
    one = len(outliers) == 1
    text += (
        f"keypoint{'' if one else 's'} {named} {'does' if one else 'do'} not fit the others "
        "(counted from 0, with the distance from where those put it)"
    )
    return EstimateWarning("outlier", text, 0, tuple(sorted(outliers)))


def unverified_stretch(result: FittedKeypoints) -> EstimateWarning | None:
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
    scale = dict(zip("xyz", uncertainty_of(free.fisher_covariance).scale, strict=True))
    doubtful = [axis for axis in sorted(held) if scale[axis] > _TESTED_TO]
    if not doubtful:
        return None
    known = " and ".join(f"s_{axis} to +-{percent(scale[axis])}" for axis in doubtful)
    return EstimateWarning(
        "scale",
        f"the scale is held at 1, which is not tested: free, the keypoints determine {known} only",
    )


def _contradicting_scale(tested: _Tested) -> tuple[float, float, float] | None:
    """The scales without the constraints on them, if these contradict the keypoints."""
    options = tested.options
    if len(options.stretched_axes) == _SCALES and options.stretch_sigma is None:
        return None
    if not tested.may_fall(_FALSE_STRETCH_ALARMS, _SCALES):
        return None
    free = tested.again(stretch=None, stretch_sigma=None)
    if free is None:  # the keypoints do not determine the scales, so nothing contradicts
        return None
    if chi_square_tail(tested.chi_square - free.chi_square, _SCALES) >= _FALSE_STRETCH_ALARMS:
        return None
    x, y, z = free.alignment.scale.tolist()
    return x, y, z


def _contradicting_camera(tested: _Tested) -> Camera | None:
    """The camera that the keypoints fit instead of the given one, if they contradict it.

    Tried are a focal length of their own and images of another size than the camera's, unless the
    keypoints fit and the derivative by the focal length promises nothing.
    """
    if tested.options.focal == "estimate" or tested.redundancy < 1:
        return None
    if not tested.may_fall(_FALSE_CAMERA_ALARMS, 1):
        return None
    if tested.passes and tested.decrease_by_focal() < _WORTH_A_SEARCH:
        return None
    from cadalign.estimation.uncertainty.summary import OTHER_SIZES  # rarely asked

    found = [tested.again(focal="estimate")]
    for factor in OTHER_SIZES:
        given = tested.camera.width, tested.camera.height
        sizes = (max(1, round(size * factor)) for size in given)
        found.append(tested.again(camera=tested.camera.resized(*sizes)))
    fits = [each for each in found if each is not None and each.passes]
    if not fits:
        return None
    best = min(fits, key=lambda each: each.chi_square)
    decrease = tested.chi_square - best.chi_square
    return best.camera if chi_square_tail(decrease, 1) < _FALSE_CAMERA_ALARMS else None


def _outliers(tested: _Tested) -> dict[int, float]:
    """The few keypoints without which the others pass the test, with their distances [px]."""

    def fit(rows: Rows, robust: bool) -> FittedKeypoints:
        loss = "cauchy" if robust else "linear"
        return tested.fit(rows, loss=loss, loss_scale=FitOptions.loss_scale)

    def fit_rows(rows: Rows, robust: bool) -> PlacedRows:
        fitted = fit(rows, robust)
        return fitted.alignment, fitted.camera, fitted.fisher_covariance

    points, unknowns = (tested.points_3d, tested.points_2d), tested.options.unknowns
    found = find_outliers(*points, fit_rows, unknowns=unknowns, noise=tested.covariances)
    if not 0 < len(found) <= _MOST_OUTLIERS * len(tested.rows):
        return {}
    rest = fit(np.setdiff1d(np.arange(len(tested.rows)), list(found)), False)
    if not _Tested.of(rest).passes:
        return {}
    return {int(tested.rows[row]): length for row, length in found.items()}


def unexplained(sigma: float, points_2d: Sequence[FloatArray]) -> Warnings:
    """Warn of an estimated sigma [px] that is nearly the spread of the keypoints of views (n, 2).

    In 98 % of pairs of a category's models it is a smaller share, of keypoints in random order in
    2 %.
    """
    with np.errstate(over="ignore"):  # of keypoints beyond all images
        spread = max(float(points.std(axis=0).max()) for points in points_2d if len(points))
    if sigma <= _LARGEST_SHARE * spread:
        return ()
    share = f"{sigma:.3g} px, {100 * sigma / spread:.0f} % of the keypoints' standard deviation"
    text = f"sigma is {share}: the model explains next to nothing of them, check which is which"
    return (EstimateWarning("noise", text),)


def is_large_sigma(sigma: float, points_2d: Sequence[FloatArray]) -> bool:
    """True for an estimated sigma [px] that is large beside the extent of views' keypoints (n, 2).

    It asks for a mistake.
    """
    extents = [float(np.ptp(points, axis=0).max()) for points in points_2d if len(points)]
    return sigma > _LARGE * max(extents, default=0.0)
