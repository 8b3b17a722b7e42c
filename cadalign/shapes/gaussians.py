"""Mixtures of Gaussians, learned from vectors with missing entries.

Expectation maximisation as in Ghahramani and Jordan, "Supervised learning from incomplete data via
an EM approach", NIPS 1994, with a prior that draws each covariance towards a common one, so that
components of few vectors keep sensible covariances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray

_UNSEEN = 1e-6  # weight of the previous mean: a component without vectors stays where it is


class Gaussians(NamedTuple):
    """A mixture of Gaussians: weights (g,), which sum to 1, means (g, d), covariances (g, d, d)."""

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray

    def widened(self, sigma: float) -> Gaussians:
        """The distribution of the vectors with independent noise in every entry."""
        noise = sigma**2 * np.eye(self.means.shape[1])
        return Gaussians(self.weights, self.means, self.covariances + noise)


Prior = tuple[FloatArray, float, float]
"""What covariances are drawn towards (d, d), the number of vectors that it counts as, and the
standard deviation that no direction falls below."""


class Pattern(NamedTuple):
    """Vectors, by their ``rows`` (r,), that have the same entries ``seen`` (n,), and no others.

    ``values`` (r, n) are what they have, ``missing`` (d - n,) the entries that they lack.
    """

    rows: IntArray
    seen: IntArray
    missing: IntArray
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Vectors:
    """Weighted vectors with missing entries."""

    values: FloatArray  # (N, d), NaN for what is missing; every vector has an entry
    weights: FloatArray  # (N,), how often each vector counts

    @cached_property
    def patterns(self) -> tuple[Pattern, ...]:
        """The vectors grouped by the entries that they have."""
        has = ~np.isnan(self.values)
        if has.all():  # saves the sorting
            kinds, kind_of = has[:1], np.zeros(len(has), dtype=np.int64)
        else:
            kinds, kind_of = np.unique(has, axis=0, return_inverse=True)
        found = []
        for number, kind in enumerate(kinds):
            rows, seen = np.flatnonzero(kind_of.ravel() == number), np.flatnonzero(kind)
            values = self.values[np.ix_(rows, seen)]
            found.append(Pattern(rows, seen, np.flatnonzero(~kind), values))
        return tuple(found)

    @cached_property
    def mean(self) -> FloatArray:
        """Mean of each entry; of the entries that no vector has, the mean of all entries."""
        missing = np.isnan(self.values)
        totals = np.where(missing, 0.0, self.weights[:, None]).sum(axis=0)
        sums = (self.weights[:, None] * np.where(missing, 0.0, self.values)).sum(axis=0)
        overall = sums.sum() / totals.sum()
        return np.asarray(np.where(totals > 0, sums / np.where(totals > 0, totals, 1.0), overall))

    @property
    def variance(self) -> float:
        """Mean squared distance of the entries from their means."""
        return float(np.nanmean((self.values - self.mean) ** 2))

    def completed(self, model: Gaussians) -> FloatArray:
        """The vectors with their expected missing entries under the first component, (N, d)."""
        return _expect(self, np.zeros(len(self.values)), model, 0)[0]


def log_likelihoods(values: FloatArray, model: Gaussians) -> FloatArray:
    """Log density of the entries of vectors, (N, d) float, under a mixture; (N,) float."""
    densities = _log_densities(Vectors(values, np.ones(len(values))), model)
    return np.asarray(np.logaddexp.reduce(densities, axis=1))


def learn_gaussian(vectors: Vectors, *, strength: float, floor: float, rounds: int) -> Gaussians:
    """Learn one Gaussian; its covariance is drawn towards that of independent, equal entries."""
    width = (vectors.variance + floor**2) * np.eye(vectors.values.shape[1])
    start = Gaussians(np.ones(1), vectors.mean[None], width[None])
    model, prior = start, (width, strength, floor)
    shares = vectors.weights[:, None]
    for _ in range(rounds):
        model = _maximise(vectors, shares, model, prior)
    return model


def learn_mixture(
    vectors: Vectors,
    labels: IntArray,
    common: Gaussians,
    *,
    strength: float,
    floor: float,
    rounds: int,
) -> Gaussians:
    """Learn a mixture from a first clustering.

    ``labels`` (N,) are the components that the vectors start in, ``common`` is the Gaussian of all,
    from which the components start. Covariances are drawn towards their mean over the components;
    for ``strength`` and ``floor`` see `Prior`.
    """
    count = int(labels.max()) + 1
    model = Gaussians(
        np.full(count, 1 / count),
        np.repeat(common.means, count, axis=0),
        np.repeat(common.covariances, count, axis=0),
    )
    responsibilities = np.eye(count)[labels]
    for turn in range(rounds):
        if turn:
            densities = _log_densities(vectors, model)
            densities -= np.logaddexp.reduce(densities, axis=1, keepdims=True)
            responsibilities = np.exp(densities)
        within = np.einsum("g,gij->ij", model.weights, model.covariances)
        shares = vectors.weights[:, None] * responsibilities
        model = _maximise(vectors, shares, model, (within, strength, floor))
    return model


def _log_densities(vectors: Vectors, model: Gaussians) -> FloatArray:
    """Log of weight times density of every vector under every component, (N, g) float."""
    found = np.empty((len(vectors.values), len(model.weights)))
    for pattern in vectors.patterns:
        seen = pattern.seen
        constant = len(seen) / 2 * math.log(2 * math.pi)
        for number, weight in enumerate(model.weights):
            root = _root(model.covariances[number][seen[:, None], seen])
            whitened = _solve(root, (pattern.values - model.means[number][seen]).T)
            volume = np.log(root.diagonal()).sum() + constant
            squares = np.einsum("nr,nr->r", whitened, whitened)
            found[pattern.rows, number] = math.log(max(weight, 1e-300)) - volume - squares / 2
    return found


def _expect(
    vectors: Vectors, shares: FloatArray, model: Gaussians, number: int
) -> tuple[FloatArray, FloatArray]:
    """Expected vectors, and the covariance of what is missing, summed with shares as weights."""
    mean, covariance = model.means[number], model.covariances[number]
    completed, spread = vectors.values.copy(), np.zeros_like(covariance)
    for pattern in vectors.patterns:
        seen, missing = pattern.seen, pattern.missing
        if not len(missing):
            continue
        root = _root(covariance[seen[:, None], seen])
        whitened = _solve(root, (pattern.values - mean[seen]).T)
        across = _solve(root, covariance[seen[:, None], missing])
        completed[pattern.rows[:, None], missing] = mean[missing] + whitened.T @ across
        rest = covariance[missing[:, None], missing] - across.T @ across
        spread[missing[:, None], missing] += shares[pattern.rows].sum() * rest
    return completed, spread


def _maximise(vectors: Vectors, shares: FloatArray, model: Gaussians, prior: Prior) -> Gaussians:
    """One round: the mixture that makes the completed vectors most likely."""
    means, covariances = [], []
    towards, strength, floor = prior
    for number, share in enumerate(shares.T):
        completed, spread = _expect(vectors, share, model, number)
        mean = share @ completed + _UNSEEN * model.means[number]
        mean /= share.sum() + _UNSEEN
        offsets = completed - mean
        scatter = offsets.T @ (share[:, None] * offsets) + spread
        scatter += (strength + _UNSEEN) * towards
        covariance = scatter / (share.sum() + strength + _UNSEEN)
        covariance[np.diag_indices_from(covariance)] += floor**2
        means.append(mean)
        covariances.append(covariance)
    totals = shares.sum(axis=0) + _UNSEEN
    return Gaussians(totals / totals.sum(), np.array(means), np.array(covariances))


# SciPy's own checks would take longer than the factorisation of such small matrices.
def _root(covariance: FloatArray) -> FloatArray:
    from scipy.linalg.lapack import dpotrf

    root, info = dpotrf(covariance, lower=1, clean=1)
    if info:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return np.asarray(root)


def _solve(root: FloatArray, right: FloatArray) -> FloatArray:
    from scipy.linalg.lapack import dtrtrs

    solution, _ = dtrtrs(root, right, lower=1)
    return np.asarray(solution)
