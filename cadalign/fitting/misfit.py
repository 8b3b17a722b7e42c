"""Test of the residuals against the keypoints' standard deviations, and what does not fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import CadalignError, InputError
from cadalign.fitting.chi_square import upper_tail
from cadalign.fitting.likelihood import Likelihood
from cadalign.fitting.options import FitOptions
from cadalign.fitting.uncertainty import WEAK_SCALE, percent, uncertainty_of
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.fitting.outliers import Rows
    from cadalign.fitting.result import FitResult

_FALSE_ALARMS = 0.004
_FALSE_STRETCH_ALARMS = 0.002
_MOST_OUTLIERS = 1 / 3  # of the keypoints; more are no outliers
_MOST_NAMED = 5
_SCALES = 2  # unknown ones, of an alignment without constraints


@dataclass(frozen=True)
class Misfit:
    """Residuals that are larger than the standard deviations of the keypoints explain.

    Parameters
    ----------
    chi_square : float
        Sum of the losses on the whitened residuals: of their squares, with the linear loss.
    redundancy : int
        What is expected of it: the equations minus the unknowns.
    free_scale : tuple of 3 float, optional
        The scales without the constraints on them (stretch=, scale_prior_sigma), where it is these
        that contradict the keypoints.
    outliers : mapping of int to float
        The keypoints without which the others fit, and their distances from where the others put
        them [px]; empty where no few keypoints are to blame.
    """

    chi_square: float
    redundancy: int
    free_scale: tuple[float, float, float] | None = None
    outliers: Mapping[int, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, for JSON."""
        outliers = [{"row": row, "distance_px": px} for row, px in self.outliers.items()]
        return {
            "chi_square": self.chi_square,
            "redundancy": self.redundancy,
            "free_scale": None if self.free_scale is None else list(self.free_scale),
            "outliers": outliers,
        }

    def __str__(self) -> str:
        if self.free_scale is not None:
            scale = ", ".join(f"{value:.3g}" for value in self.free_scale)
            return (
                f"the keypoints contradict the constraint on the stretch: without it they fit "
                f"better, with the scale ({scale})"
            )
        ratio = math.sqrt(self.chi_square / self.redundancy)
        text = f"the residuals are {ratio:.2g} times as large as sigma explains: "
        if not self.outliers:
            return text + (
                "the keypoints do not fit the model together (wrong pairs, model, stretch or "
                "camera), or sigma is too small; sigma=None suits a model that is only similar"
            )
        worst = sorted(self.outliers, key=lambda row: -self.outliers[row])[:_MOST_NAMED]
        named = ", ".join(f"{row} ({self.outliers[row]:.3g} px)" for row in worst)
        if len(worst) < len(self.outliers):
            named += f" and {len(self.outliers) - len(worst)} more"
        one = len(self.outliers) == 1
        return text + (
            f"keypoint{'' if one else 's'} {named} {'does' if one else 'do'} not fit the others "
            "(counted from 0, with the distance from where those put it)"
        )


def find_misfit(result: FitResult, options: FitOptions) -> Misfit | None:
    """Test the residuals of the inliers by chi-square; None if they pass, or sigma is estimated.

    The sum of squares at the optimum has the redundancy as its expectation; a robust loss, which is
    at most the square, only makes the test more cautious, and so does the cut of RANSAC. Priors
    count as equations that are always met. A constraint on the scales is tested by the decrease of
    the sum without it, which has one degree of freedom for each scale.
    """
    if options.sigma is None:
        return None
    try:
        tested = _Tested.of(result, options)
    except InputError:  # a depth that rounds to zero has no projection
        return None
    free_scale = _contradicting_scale(tested)
    if free_scale is not None:
        return Misfit(tested.chi_square, tested.redundancy, free_scale)
    if tested.passes:
        return None
    return Misfit(tested.chi_square, tested.redundancy, outliers=_outliers(tested))


def unverified_stretch(result: FitResult, options: FitOptions) -> str | None:
    """Warn about scales held at 1 where the keypoints would not contradict another value.

    None where nothing is held, sigma is estimated, or the free scales are not determined at all,
    which is what holding them is for.
    """
    held = set("xyz") - {options.known_axis} - set(options.stretched_axes)
    if not held or options.sigma is None:
        return None
    try:
        free = _Tested.of(result, options).fit(stretch=None)
    except CadalignError:
        return None
    assert free.covariance is not None
    scale = uncertainty_of(free.covariance, free.known_axis).scale
    doubtful = [axis for axis in sorted(held) if scale["xyz".index(axis)] > WEAK_SCALE]
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
    def of(cls, result: FitResult, options: FitOptions) -> _Tested:
        rows = np.flatnonzero(result.inliers)
        points_3d, residuals = result.points_3d[rows], result.residuals[rows]
        projected = result.camera.project(result.alignment.apply(points_3d))
        likelihood = Likelihood.of(result, options)
        covariances = np.linalg.inv(likelihood.information)
        return cls(
            points_3d,
            projected - residuals,
            np.broadcast_to(covariances, (len(rows), 2, 2)),
            rows,
            result.camera,
            options,
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
        return redundancy <= 0 or upper_tail(self.chi_square, redundancy) >= _FALSE_ALARMS

    def fit(self, rows: Rows | slice = slice(None), **changes: Any) -> FitResult:
        """Fit some of the keypoints anew, with changed options."""
        from cadalign.fitting.fit import fit

        chosen = {**vars(self.options), "sigma": self.covariances[rows], **changes}
        return fit(self.points_3d[rows], self.points_2d[rows], self.camera, **chosen)


def _contradicting_scale(tested: _Tested) -> tuple[float, float, float] | None:
    """The scales without the constraints on them, if these contradict the keypoints."""
    options = tested.options
    if len(options.stretched_axes) == _SCALES and options.scale_prior_sigma is None:
        return None
    try:
        free = tested.fit(stretch=None, scale_prior_sigma=None)
        assert free.options is not None
        decrease = tested.chi_square - _Tested.of(free, free.options).chi_square
    except CadalignError:  # the keypoints do not determine the scales, so nothing contradicts
        return None
    if upper_tail(decrease, _SCALES) >= _FALSE_STRETCH_ALARMS:
        return None
    x, y, z = free.alignment.scale.tolist()
    return x, y, z


def _outliers(tested: _Tested) -> dict[int, float]:
    """The few keypoints without which the others pass the test, with their distances [px]."""
    from cadalign.fitting.outliers import NoiseLevel, find_outliers

    def fit_rows(rows: Rows, robust: bool) -> FitResult:
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
    assert rest.options is not None
    if not _Tested.of(rest, rest.options).passes:
        return {}
    return {int(tested.rows[row]): length for row, length in found.items()}
