"""Mixtures of Gaussians, learned from vectors with missing entries.

Expectation maximisation as in Ghahramani and Jordan, "Supervised learning from incomplete data via
an EM approach", NIPS 1994, with a prior on the covariances: that of a component is drawn towards a
wider one by as much as `Shrinkage.strength` vectors count, so that components of few vectors, and
entries that few vectors have, keep sensible covariances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from cadalign.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A mixture of Gaussians.

    Parameters
    ----------
    weights : (g,) float
        Sum to 1.
    means : (g, d) float
    covariances : (g, d, d) float
    """

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray


@dataclass(frozen=True, eq=False)
class Pattern:
    """Vectors that have the same entries.

    Parameters
    ----------
    rows : (r,) int
        Which vectors.
    seen, missing : (n,) and (d - n,) int
        The entries that they have and lack.
    values : (r, n) float
        What they have.
    """

    rows: IntArray
    seen: IntArray
    missing: IntArray
    values: FloatArray


def patterns_of(vectors: FloatArray) -> list[Pattern]:
    """Group vectors, (N, d) float with NaN for what is missing, by the entries that they have."""
    seen = ~np.isnan(vectors)
    kinds, kind_of = np.unique(seen, axis=0, return_inverse=True)
    found = []
    for number, kind in enumerate(kinds):
        rows = np.flatnonzero(kind_of.ravel() == number)
        entries = np.flatnonzero(kind)
        values = vectors[np.ix_(rows, entries)]
        found.append(Pattern(rows, entries, np.flatnonzero(~kind), values))
    return found


def log_densities(patterns: list[Pattern], count: int, model: Gaussians) -> FloatArray:
    """Log of weight times density of every vector under every component, (N, g) float."""
    found = np.empty((count, len(model.weights)))
    for pattern in patterns:
        for number, weight in enumerate(model.weights):
            whitened, log_root = _whiten(pattern, model, number)
            squares = (whitened**2).sum(axis=0)
            constant = math.log(weight) - log_root - len(pattern.seen) / 2 * math.log(2 * math.pi)
            found[pattern.rows, number] = constant - squares / 2
    return found


def log_likelihoods(vectors: FloatArray, model: Gaussians) -> FloatArray:
    """Log density of each vector's entries under the mixture, (N,) float."""
    densities = log_densities(patterns_of(vectors), len(vectors), model)
    return np.asarray(np.logaddexp.reduce(densities, axis=1))


def _whiten(pattern: Pattern, model: Gaussians, number: int) -> tuple[FloatArray, float]:
    seen = pattern.seen
    root = np.linalg.cholesky(model.covariances[number][np.ix_(seen, seen)])
    offsets = pattern.values - model.means[number][seen]
    whitened = solve_triangular(root, offsets.T, lower=True, check_finite=False)
    return whitened, float(np.log(np.diag(root)).sum())


@dataclass(frozen=True, eq=False)
class Moments:
    """Expected vectors and their scatter under one component.

    Parameters
    ----------
    vectors : (N, d) float
        The vectors, what is missing replaced by its expectation.
    spread : (d, d) float
        Sum over the vectors of responsibility times the covariance of what is missing.
    """

    vectors: FloatArray
    spread: FloatArray


def expect(
    patterns: list[Pattern], responsibilities: FloatArray, mean: FloatArray, covariance: FloatArray
) -> Moments:
    """Complete vectors by their expectations under one Gaussian."""
    vectors = np.empty((len(responsibilities), len(mean)))
    spread = np.zeros_like(covariance)
    for pattern in patterns:
        seen, missing = pattern.seen, pattern.missing
        vectors[np.ix_(pattern.rows, seen)] = pattern.values
        if not len(missing):
            continue
        root = np.linalg.cholesky(covariance[np.ix_(seen, seen)])
        across = covariance[np.ix_(seen, missing)]
        gain = cho_solve((root, True), across, check_finite=False)
        offsets = pattern.values - mean[seen]
        vectors[np.ix_(pattern.rows, missing)] = mean[missing] + offsets @ gain
        rest = covariance[np.ix_(missing, missing)] - across.T @ gain
        spread[np.ix_(missing, missing)] += responsibilities[pattern.rows].sum() * rest
    return Moments(vectors, spread)


@dataclass(frozen=True)
class Shrinkage:
    """Prior on the covariances.

    Parameters
    ----------
    strength : float
        How many vectors the prior counts as.
    floor : float
        Standard deviation that no direction falls below.
    """

    strength: float
    floor: float


def learn_gaussian(
    vectors: FloatArray, weights: FloatArray, shrinkage: Shrinkage, rounds: int = 25
) -> Gaussians:
    """Learn one Gaussian from vectors with missing entries.

    Parameters
    ----------
    vectors : (N, d) float
        NaN for what is missing; every entry is there once at least.
    weights : (N,) float
        How often each vector counts.
    """
    patterns, count = patterns_of(vectors), len(vectors)
    mean = np.nansum(weights[:, None] * vectors, axis=0)
    mean /= np.where(np.isnan(vectors), 0.0, weights[:, None]).sum(axis=0)
    width = np.nanmean((vectors - mean) ** 2) + shrinkage.floor**2
    target = width * np.eye(len(mean))
    covariance = target
    for _ in range(rounds):
        moments = expect(patterns, weights, mean, covariance)
        mean = weights @ moments.vectors / weights.sum()
        covariance = _covariance(moments, mean, weights, shrinkage, target)
    del count
    return Gaussians(np.ones(1), mean[None], covariance[None])


def learn_mixture(
    vectors: FloatArray,
    weights: FloatArray,
    responsibilities: FloatArray,
    common: Gaussians,
    shrinkage: Shrinkage,
    rounds: int = 40,
) -> Gaussians:
    """Learn a mixture from first responsibilities, (N, g) float.

    Covariances are drawn towards that of ``common``, the Gaussian of all vectors.
    """
    patterns = patterns_of(vectors)
    count = responsibilities.shape[1]
    target = common.covariances[0]
    model = Gaussians(
        np.full(count, 1 / count),
        np.repeat(common.means, count, axis=0),
        np.repeat(common.covariances, count, axis=0),
    )
    for turn in range(rounds):
        if turn:
            densities = log_densities(patterns, len(vectors), model)
            densities -= np.logaddexp.reduce(densities, axis=1, keepdims=True)
            responsibilities = np.exp(densities)
        model = _maximised(patterns, weights[:, None] * responsibilities, model, target, shrinkage)
    return model


def _maximised(
    patterns: list[Pattern],
    shares: FloatArray,
    model: Gaussians,
    target: FloatArray,
    shrinkage: Shrinkage,
) -> Gaussians:
    means, covariances = [], []
    for number, share in enumerate(shares.T):
        moments = expect(patterns, share, model.means[number], model.covariances[number])
        # The prior's vectors lie at the mean of the component as it was: it stays where nobody is.
        mean = share @ moments.vectors + 1e-6 * model.means[number]
        mean /= share.sum() + 1e-6
        means.append(mean)
        covariances.append(_covariance(moments, mean, share, shrinkage, target))
    totals = shares.sum(axis=0) + 1e-9
    return Gaussians(totals / totals.sum(), np.array(means), np.array(covariances))


def _covariance(
    moments: Moments,
    mean: FloatArray,
    weights: FloatArray,
    shrinkage: Shrinkage,
    target: FloatArray,
) -> FloatArray:
    offsets = moments.vectors - mean
    scatter = offsets.T @ (weights[:, None] * offsets) + moments.spread
    scatter += shrinkage.strength * target
    covariance = scatter / (weights.sum() + shrinkage.strength)
    covariance[np.diag_indices_from(covariance)] += shrinkage.floor**2
    return np.asarray(covariance)
