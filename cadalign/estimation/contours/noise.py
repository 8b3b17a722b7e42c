"""Noise of a mask's contour: standard deviation, correlation, and what all of a contour shares.

A contour lies beside the rim by an offset that all of it has in common, of a mask that is dilated
say, and by its registration: programs place pixels' centres half a pixel apart, and annotators
click no better. Both are unknown, and integrated out with the rest of the shape.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.contour import (
    Contour,
    correlation_length,
    robust_deviation,
    trimmed_deviation,
)
from cadalign.estimation.contours.rims import Rims
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import Evidence, State

OWN_MODES = 3
"""Unknowns of a contour: its offset outwards, its registration along x and along y."""
REGISTRATION = 0.3
"""Standard deviation of a contour's registration along x and y [px]."""

_LOSS_SCALE = 2.4  # in standard deviations: Cauchy's loss then keeps 95 % of the information
_LEAST_LOSS_SCALE = 1.0  # [px]: where pixels end, they displace a contour by up to that
_LEAST_SIGMA = 0.1  # [px]
_FIRST_OFFSET = 1.0  # [px], standard deviation of the offset that all of a contour has in common
_LEAST_OFFSET = 0.1
_UNEVEN = 0.05  # share of the offset by which it differs from edge to edge
_EDGE = 30.0  # samples of an edge
_OF_PIXELS = 3.0  # samples that count as one where pixels alone displace them
_FIRST_CORRELATION = 10.0  # samples, of a surface that is only similar
_LEAST_INFORMATION = 1e-12  # about an unknown, relative
_LEAST_OWN = 0.3  # [px], standard deviation of the part that is the model's
_FIRST_SHARE, _LARGEST_SHARE = 0.8, 0.99  # of a contour, that is the model's
_ROUNDS = 30
_ALIKE = 0.2  # change of a variance's logarithm


def cost_of_contour(residuals: FloatArray, reach: float) -> float:
    """The mean of -log density of a contour's distances (S,) from a rim, at most ``reach`` [px].

    Part of the contour is an occluder's, and lies anywhere within the reach; the rest is Gaussian.
    Its share and standard deviation are the likeliest, by expectation and maximisation (Dempster,
    Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977).
    """
    squares, elsewhere = residuals**2, 1 / (2 * reach)
    share, variance = _FIRST_SHARE, max(float(np.median(squares)), _LEAST_OWN**2)
    for _ in range(_ROUNDS):
        own = share * np.exp(-squares / (2 * variance)) / np.sqrt(2 * np.pi * variance)
        density = own + (1 - share) * elsewhere
        belongs = own / density
        share = min(float(belongs.mean()), _LARGEST_SHARE)
        variance = max(float(belongs @ squares / max(belongs.sum(), 1e-9)), _LEAST_OWN**2)
    return float(-np.log(density).mean())


class Noise(NamedTuple):
    """Noise of a contour's samples.

    Their standard deviation ``sigma`` [px], the number of neighbours that count as one, and the
    standard deviation of the ``offset`` [px] that all have in common.
    """

    sigma: float
    correlation: float
    offset: float

    @property
    def loss_scale(self) -> float:
        """Scale of Cauchy's loss, in standard deviations of a sample."""
        return max(_LOSS_SCALE, _LEAST_LOSS_SCALE / self.sigma)

    def cost(self, residual: float) -> float:
        """Cost of one sample's residual [px]."""
        square = self.loss_scale**2
        return float(square / self.correlation * np.log1p((residual / self.sigma) ** 2 / square))

    def is_like(self, other: Noise) -> bool:
        """True if samples weigh about the same."""
        weights = self.sigma**2 * self.correlation / (other.sigma**2 * other.correlation)
        offsets = (self.offset / other.offset) ** 2
        return bool(max(abs(np.log(weights)), abs(np.log(offsets))) < _ALIKE)


def first_noise(sigma: float | None, reach: float, *, is_exact: bool) -> Noise:
    """The noise before rims are found, at most ``reach`` [px] away; ``sigma`` where it is given."""
    if is_exact:
        return Noise(sigma or reach / 3, 1.0, _FIRST_OFFSET)
    return Noise(reach / 3, _FIRST_CORRELATION, _LEAST_OFFSET)


def noise_of(
    contour: Contour,
    sigma: float | None,
    rims: Rims,
    residuals: FloatArray,
    noise: Noise,
    *,
    correlated: bool,
) -> Noise:
    """Noise that the residuals (S,) [px] show, free of the extraction's bias.

    The correlation is that of the samples' influence on the estimate, which runs of outliers have,
    too; what the residuals don't reach of the given ``sigma`` is correlated as pixels are. Beside
    the rim a contour lies unevenly, by a share of the offset that all of an edge has in common.
    """
    found = trimmed_deviation(residuals[rims.found], _LEAST_LOSS_SCALE)
    measured = max(found, _LEAST_SIGMA)
    sigma = measured if sigma is None else sigma
    length = 1.0
    if correlated:
        some = np.nan_to_num(residuals)
        scale = max(_LOSS_SCALE * measured, _LEAST_LOSS_SCALE)
        influence = some / (1 + (some / scale) ** 2)
        share = min((found / sigma) ** 2, 1.0)
        along = max(correlation_length(contour, influence, rims.found), _OF_PIXELS)
        length = share * along + (1 - share) * _OF_PIXELS
        length += _EDGE * (_UNEVEN * noise.offset / sigma) ** 2
    return Noise(sigma, length, noise.offset)


def noise_of_similar(
    contour: Contour, sigma: float | None, rims: Rims, residuals: FloatArray, reach: float
) -> Noise:
    """Noise where the surface is only similar to the object's.

    Samples without a rim count as the farthest: there the surface lacks a part or has one more.
    """
    everywhere = np.nan_to_num(residuals, nan=reach)
    found = max(robust_deviation(everywhere), sigma or _LEAST_SIGMA)
    length = correlation_length(contour, np.nan_to_num(residuals), rims.found)
    return Noise(found, length, _LEAST_OFFSET)


def with_learned_offsets(
    evidence: Evidence, state: State, noises: list[Noise], own: FloatArray
) -> tuple[list[Noise], FloatArray]:
    """Noises with the standard deviations of the offsets learned by their own likelihood.

    The contours' ``own`` coefficients (V, 3), last of the evidence's unknowns, come along.
    """
    _, information = information_of(evidence, state)
    size = len(information)
    rows = np.arange(size - own.size, size, OWN_MODES)
    sizes = np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scaled = information / np.outer(sizes, sizes) + _LEAST_INFORMATION * np.eye(size)
    columns = np.linalg.solve(scaled, np.eye(size)[:, rows])
    variances = columns[rows].diagonal() / sizes[rows] ** 2
    learned = []
    for noise, coefficient, variance in zip(noises, own[:, 0], variances, strict=True):
        without_prior = 1 / max(1 / min(variance, 1.0) - 1, 1e-6)  # in squares of noise.offset
        free = coefficient * (1 + without_prior)
        square = noise.offset**2 * max(free**2 - without_prior, 0.0)
        learned.append(noise._replace(offset=max(float(np.sqrt(square)), _LEAST_OFFSET)))
    scales = [before.offset / after.offset for before, after in zip(noises, learned, strict=True)]
    return learned, own * np.column_stack([scales, np.ones((len(own), OWN_MODES - 1))])
