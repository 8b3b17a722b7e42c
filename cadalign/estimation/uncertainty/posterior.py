"""Posterior covariance of an alignment with few keypoints.

With few keypoints, the inverse Fisher information is too optimistic: with 6 keypoints and 1 px of
noise, its 95 % ellipsoid contains the truth in 3 of 4 cases.
The posterior under flat priors is integrated by adaptive importance sampling with Student proposals
(Cappe et al., "Adaptive importance sampling in general mixture classes", 2008), in coordinates in
which it is nearly Gaussian: the rotation vector, the direction and log distance of the keypoints'
centroid, and the logarithms of scales and focal length. The draws are the same for every result.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.estimation.options import LOSSES, FitOptions, pixel_information
from cadalign.estimation.problems import whitening_by
from cadalign.estimation.result_parts import FittedKeypoints
from cadalign.estimation.uncertainty.residuals import (
    chi_square_quantile,
    f_quantile,
    loss_weights,
    whitening_matrices,
)
from cadalign.geometry.camera import face_pixels, needs_facing, rotate_alignment, rotate_covariance
from cadalign.geometry.rotations import by_rotation
from cadalign.io.focal import FocalPrior
from cadalign.solvers.draws import CentredAlignment, LogPriors, WhitenedPixels, weigh_draws

MOST_POINTS = 100
"""Largest number of keypoints for sampling; with more, the Fisher information is accurate."""
_DRAWS = (500, 500, 1000, 2000, 4000)
_ENOUGH_EFFECTIVE = 300.0  # effective draws that end the sampling
_FREEDOM = 5.0  # degrees of freedom of the Student proposals
_FIRST_INFLATION = 1.5  # of the inverse Fisher information in the first proposal
_INFLATION = 1.3
_FEW_EFFECTIVE = 60.0  # effective draws below which the weights are tempered
_COVERAGE = 0.95
_NOISE_OF_DRAWS = 1.25  # ratio of variances within the noise of the draws
_SEED = 0
# Of an estimated sigma; an order statistic varies more than a sum of squares.
_EFFICIENCY = {"linear": 1.0, "huber": 0.7, "cauchy": 0.7}


def keypoint_covariance(fitted: FittedKeypoints) -> FloatArray | None:
    """The posterior covariance (9, 9) or (10, 10); None without a Fisher information."""
    if fitted.fisher_covariance is None:
        return None
    if needs_facing([fitted.camera]):
        kept = fitted.alignment.apply(fitted.points_3d[fitted.inliers])
        camera = face_pixels(fitted.camera, fitted.camera.project(kept))
        turn = camera.lens_from_camera
        own = replace(
            fitted,
            camera=camera,
            alignment=rotate_alignment(fitted.alignment, turn.T),
            fisher_covariance=rotate_covariance(fitted.fisher_covariance, turn.T),
        )
        covariance = rotate_covariance(_posterior_covariance(own), turn)
    else:
        covariance = _posterior_covariance(fitted)
    if fitted.symmetry is None:
        return covariance
    from cadalign.estimation.symmetry import held_axes, remove_free_turns  # most models have none

    held = held_axes(fitted.options.stretched_axes)
    best = fitted.symmetry.canonical(fitted.alignment, held=held)
    return remove_free_turns(covariance, best)


def _posterior_covariance(fitted: FittedKeypoints) -> FloatArray:
    options, points = fitted.options, fitted.points_3d[fitted.inliers]
    widening, covariance = 1.0, cast(FloatArray, fitted.fisher_covariance)
    if options.sigma is None:
        pairs = len({*map(bytes, np.hstack([points, fitted.residuals[fitted.inliers]]))})
        redundancy = max(2 * pairs - options.unknowns, 1)
        widening = widening_of(options.unknowns, redundancy * _EFFICIENCY[options.loss])
        # Sigma belongs to the keypoints: the priors are not widened.
        excess = (widening - 1) * _prior_information(options, len(covariance))
        more = np.eye(len(covariance)) + excess[:, None] * covariance
        covariance = np.asarray(widening * np.linalg.solve(more.T, covariance))
    if len(points) <= MOST_POINTS:
        # Coordinates may overflow.
        with suppress(np.linalg.LinAlgError, InputError):
            sampled = _sample(fitted, covariance, widening)
            covariance = covariance if sampled is None else sampled
    return _limit_to_prior(covariance, fitted)


def _limit_to_prior(covariance: FloatArray, result: FittedKeypoints) -> FloatArray:
    """Limit the variance of log scales in a covariance (m, m) to their prior's.

    An ellipsoid about a curved region may reach beyond the prior, whose mean square about the
    estimate bounds the variance. Well-determined ratios of scales keep their variance.
    """
    weight, width = result.options.scale_prior
    if not weight:
        return covariance
    for axis, log_scale in enumerate(np.log(result.alignment.scale), 6):
        most = log_scale**2 + width**2 / 3 + 1 / weight
        variance, own = covariance[axis, axis], covariance[axis]
        if variance > most:
            left = own * (most / variance)  # exact; the difference below loses digits
            covariance = covariance - np.outer(own / variance, own) * (1 - most / variance)
            covariance[axis], covariance[:, axis] = left, left
            np.fill_diagonal(covariance, np.maximum(covariance.diagonal(), 0.0))  # rounding errors
    return covariance


def widening_of(unknowns: int, redundancy: float) -> float:
    """Ratio of squared 95 % radii for an estimated and a known sigma."""
    quantile = unknowns * f_quantile(unknowns, redundancy, 1 - _COVERAGE)
    return quantile / chi_square_quantile(unknowns, 1 - _COVERAGE)


class Chart(NamedTuple):
    """Coordinates (10,) about an alignment; see `cadalign.solvers.draws`."""

    centred: CentredAlignment
    keypoints: WhitenedPixels
    priors: LogPriors

    @classmethod
    def from_fit(cls, fitted: FittedKeypoints, widening: float) -> Chart:
        """The chart of a fit with ``widening`` times its variance; a loss enters by its weights."""
        camera, options, alignment = fitted.camera, fitted.options, fitted.alignment
        kept, points = fitted.inliers, fitted.points_3d[fitted.inliers]
        residuals = fitted.residuals[kept]
        in_camera = alignment.apply(points)
        rays = in_camera[:, :2] / in_camera[:, 2:]
        principal, focal = (camera.cx, camera.cy), np.array([[camera.fx], [camera.fy]])
        pixels = camera.pixels_from_normalized(rays) - principal
        slopes = focal * camera.distortion_jacobian(rays)
        information = pixel_information(fitted.chosen_sigma, len(kept))[kept]
        squares = np.einsum("ni,nij,nj->n", residuals, information, residuals)
        weights = loss_weights(squares, LOSSES[options.loss], options.loss_scale)
        information = (weights / widening)[:, None, None] * information
        whitening = whitening_matrices(whitening_by(information))
        fixed = pixels - (slopes @ rays[:, :, None])[:, :, 0]
        columns = np.stack([fixed, pixels - residuals], axis=2)
        fixed, seen = np.moveaxis(whitening @ columns, 2, 0)
        center = points.mean(axis=0)
        keypoints = WhitenedPixels(points - center, whitening @ slopes, fixed.copy(), seen.copy())
        moved = alignment.rotation.ravel(), alignment.apply(center[None])[0], alignment.scale
        centred = CentredAlignment(np.concatenate(moved), center, alignment.translation)
        prior = options.focal_prior
        of_focal = 0.0, 0.0
        if isinstance(prior, FocalPrior):
            of_focal = prior.relative_sigma**-2, math.log(prior.focal / camera.fx)
        return cls(centred, keypoints, LogPriors(*options.scale_prior, *of_focal))

    def jacobian(self) -> FloatArray:
        """Derivatives (10, 10) of the coordinates by a covariance's unknowns."""
        pose, center, _ = self.centred
        of_axes = pose[:9].reshape(3, 3) * (pose[12:] * center)
        of_center = np.zeros((3, 10))
        of_center[:, :3] = by_rotation(of_axes.sum(axis=1))
        of_center[:, 3:6] = np.eye(3)
        of_center[:, 6:9] = of_axes
        u, v, depth = pose[9:12]
        jacobian = np.eye(10)
        jacobian[3:6] = np.array([[1, 0, -u / depth], [0, 1, -v / depth], [0, 0, 1]]) @ of_center
        jacobian[3:6] /= depth
        return jacobian


def _prior_information(options: FitOptions, size: int) -> FloatArray:
    """Inverse variances (9,) or (10,) of the priors; 0 for none."""
    information = np.zeros(size)
    information[6:9] = options.prior_weight
    if isinstance(options.focal_prior, FocalPrior):
        information[9] = options.focal_prior.relative_sigma**-2
    return information


@np.errstate(all="ignore")  # draws that overflow have no weight
def _sample(fitted: FittedKeypoints, first: FloatArray, widening: float) -> FloatArray | None:
    """A covariance (m, m) from draws of the posterior; None if the proposals miss it.

    It is the inverse Fisher information, widened to the posterior and to the region that the
    likelihood ratio test does not reject at 5 %, so that its ellipsoid has the stated coverage.
    """
    chart, free = Chart.from_fit(fitted, widening), fitted.options.estimated_unknowns
    scales = np.flatnonzero((free >= 6) & (free < 9))
    # Sorted by variance, so that the draws do not depend on the order of the axes.
    free[scales] = free[scales][np.argsort(first.diagonal()[free[scales]], kind="stable")]
    size = len(first)
    jacobian = chart.jacobian()[:size, :size]
    proposal = (jacobian @ first @ jacobian.T)[np.ix_(free, free)] * _FIRST_INFLATION
    mean = np.zeros(len(free))
    deviations, costs, weights = np.zeros((1, 10)), np.zeros(1), np.ones(1)
    for round_, count in enumerate(_DRAWS):
        draws, log_densities = _draws(round_, len(free))
        steps = np.zeros((count, 10))
        steps[:, free] = mean + draws @ np.linalg.cholesky(proposal).T
        deviations, costs, log_weights = weigh_draws(*chart, steps)
        log_weights -= log_densities
        log_weights[~np.isfinite(log_weights)] = -np.inf
        if not log_weights.max() > -np.inf:
            return None
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        effective = 1 / (weights**2).sum()
        if effective > _ENOUGH_EFFECTIVE:
            break
        adapted = weights
        if effective < _FEW_EFFECTIVE:
            adapted = np.sqrt(weights) / np.sqrt(weights).sum()
        mean = adapted @ steps[:, free]
        centered = steps[:, free] - mean
        proposal = _INFLATION * (centered * adapted[:, None]).T @ centered
    (at_estimate,) = weigh_draws(*chart, np.zeros((1, 10)))[1]
    limit = chi_square_quantile(len(free), 1 - _COVERAGE)
    likely = costs - at_estimate <= limit
    covariance, among = np.zeros_like(first), np.ix_(free, free)
    prior = _prior_information(fitted.options, size)[free]
    moved = deviations[:, free]
    covariance[among] = _widen(first[among], prior, moved, weights, likely, limit)
    return covariance if np.isfinite(covariance).all() else None


@lru_cache(maxsize=64)
def _draws(round_: int, size: int) -> tuple[FloatArray, FloatArray]:
    """Student draws (k, size) of a round, the same for every result, and log densities (k,)."""
    rng = np.random.default_rng(_SEED)
    for count in _DRAWS[: round_ + 1]:
        normal = rng.standard_normal((count, size))
        draws = normal / np.sqrt(rng.chisquare(_FREEDOM, (count, 1)) / _FREEDOM)
    logs = -(_FREEDOM + size) / 2 * np.log1p((draws**2).sum(axis=1) / _FREEDOM)
    return draws, logs


def _widen(
    variance: FloatArray,
    prior: FloatArray,
    moved: FloatArray,
    weights: FloatArray,
    likely: BoolArray,
    limit: float,
) -> FloatArray:
    """Widen a covariance (m, m) along directions in which the draws (k, m) reach farther.

    Along principal axes of the second moments, the variance is increased to the draws' variance, or
    until the ellipsoid contains the ``likely`` draws; differences within their noise are ignored.
    """
    factor = np.linalg.cholesky(variance)
    used = (weights > 0) | likely
    moved, weights, likely = moved[used], weights[used], likely[used]
    white = np.linalg.solve(factor, moved.T)
    moments = (white * weights) @ white.T
    if not np.isfinite(moments).all():
        return np.full_like(variance, np.nan)
    spread, axes = np.linalg.eigh(moments)
    squares = (axes.T @ white[:, likely]) ** 2 / limit
    factors = np.maximum(spread, squares.max(axis=1, initial=0.0))
    wide = factors > _NOISE_OF_DRAWS
    factors[~wide] = 1.0
    # The ellipsoid through the ends of the axes may cut off corners of the region.
    factors[wide] *= (squares[wide] / factors[wide, None]).sum(axis=0).max(initial=1.0)
    widened = factor @ axes * np.sqrt(factors)
    covariance = widened @ widened.T
    # Tilted axes of curved regions must not widen unknowns that a prior determines.
    known = variance.diagonal()
    shrunk = np.where(known * prior > 0.5, np.sqrt(known / covariance.diagonal()), 1.0)
    return np.asarray(covariance * shrunk * shrunk[:, None])
