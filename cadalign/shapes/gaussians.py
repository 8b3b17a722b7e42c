"""Mixtures of Gaussians, learned from vectors with missing entries.

Expectation maximisation as in Ghahramani and Jordan, "Supervised learning from incomplete data via
an EM approach", NIPS 1994, with a prior that draws each covariance towards a common one, so that
components of few vectors keep sensible covariances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.compile import fast_sums
from cadalign.solvers.linalg import factorize, solve_factor_rows

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


class Conditional(NamedTuple):
    """A Gaussian of vectors, given the entries that these have.

    The lower ``root`` (d, d) of its covariance, and ``offsets`` (N, d) from its mean, 0 for what is
    missing. Of each of `Vectors.gaps`, the root of the inverse covariance of its l missing
    entries, given the others, and how far below the mean these are expected, (l, r).
    """

    root: FloatArray
    offsets: FloatArray
    gaps: tuple[tuple[FloatArray, FloatArray], ...]


@dataclass(frozen=True, eq=False)
class Vectors:
    """Weighted vectors with missing entries."""

    values: FloatArray  # (N, d), NaN for what is missing; every vector has an entry
    weights: FloatArray  # (N,), how often each vector counts

    @cached_property
    def has(self) -> BoolArray:
        """Mark the entries that are not missing, (N, d)."""
        return ~np.isnan(self.values)

    @cached_property
    def gaps(self) -> tuple[tuple[IntArray, IntArray], ...]:
        """Rows (r, 1) of the vectors that lack the same entries, and these entries (l,)."""
        lacking = np.flatnonzero(~self.has.all(axis=1))
        bits = np.packbits(self.has[lacking], axis=1)  # sorted faster than the entries themselves
        _, first, kind_of = np.unique(bits, axis=0, return_index=True, return_inverse=True)
        return tuple(
            (lacking[kind_of.ravel() == kind][:, None], np.flatnonzero(~self.has[row]))
            for kind, row in enumerate(lacking[first].tolist())
        )

    def offsets(self, mean: FloatArray) -> FloatArray:
        """Distances of the entries from a mean (d,), 0 for what is missing."""
        return np.where(self.has, self.values - mean, 0.0)

    @cached_property
    def mean(self) -> FloatArray:
        """Mean of each entry; of the entries that no vector has, the mean of all entries."""
        totals = np.where(self.has, self.weights[:, None], 0.0).sum(axis=0)
        sums = (self.weights[:, None] * np.where(self.has, self.values, 0.0)).sum(axis=0)
        overall = sums.sum() / totals.sum()
        return np.asarray(np.where(totals > 0, sums / np.where(totals > 0, totals, 1.0), overall))

    @property
    def variance(self) -> float:
        """Mean squared distance of the entries from their means."""
        return float(np.nanmean((self.values - self.mean) ** 2))

    def completed(self, model: Gaussians) -> FloatArray:
        """The vectors with the missing entries that their likeliest component expects, (N, d)."""
        given, unweighted = _conditionals(self, model), np.zeros(len(self.values))
        likeliest = _log_densities(self, model, given).argmax(axis=1)
        pairs = zip(model.means, given, strict=True)
        every = np.array([_expect(self, unweighted, mean, each)[0] for mean, each in pairs])
        return np.asarray(every[likeliest, np.arange(len(likeliest))])


def log_likelihoods(vectors: Vectors, model: Gaussians) -> FloatArray:
    """Log density of the entries of every vector under a mixture, (N,) float."""
    densities = _log_densities(vectors, model, _conditionals(vectors, model))
    return np.asarray(np.logaddexp.reduce(densities, axis=1))


def learn_gaussian(vectors: Vectors, *, strength: float, floor: float, rounds: int) -> Gaussians:
    """Learn one Gaussian; its covariance is drawn towards that of independent, equal entries."""
    width = (vectors.variance + floor**2) * np.eye(vectors.values.shape[1])
    start = Gaussians(np.ones(1), vectors.mean[None], width[None])
    model, prior = start, (width, strength, floor)
    shares = vectors.weights[:, None]
    for _ in range(rounds):
        model = _maximise(vectors, shares, model, _conditionals(vectors, model), prior)
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
    for ``strength`` and ``floor`` see `_maximise`.
    """
    count = int(labels.max()) + 1
    model = Gaussians(
        np.full(count, 1 / count),
        np.repeat(common.means, count, axis=0),
        np.repeat(common.covariances, count, axis=0),
    )
    responsibilities = np.eye(count)[labels]
    for turn in range(rounds):
        given = _conditionals(vectors, model)
        if turn:
            densities = _log_densities(vectors, model, given)
            densities -= np.logaddexp.reduce(densities, axis=1, keepdims=True)
            responsibilities = np.exp(densities)
        within = np.einsum("g,gij->ij", model.weights, model.covariances)
        shares = vectors.weights[:, None] * responsibilities
        model = _maximise(vectors, shares, model, given, (within, strength, floor))
    return model


def _conditionals(vectors: Vectors, model: Gaussians) -> list[Conditional]:
    """Every component, given the entries that the vectors have."""
    found = []
    for mean, covariance in zip(model.means, model.covariances, strict=True):
        root, offsets, gaps = _root(covariance), vectors.offsets(mean), []
        if vectors.gaps:
            precision = _inverse(root)
            pulled = multiplied(offsets, precision)
            for rows, missing in vectors.gaps:
                of_gap = _root(precision[missing[:, None], missing])
                below = np.array(pulled[rows, missing].T, order="C")
                solve_factor_rows(of_gap, below)
                gaps.append((of_gap, below))
        found.append(Conditional(root, offsets, tuple(gaps)))
    return found


def _log_densities(vectors: Vectors, model: Gaussians, given: Sequence[Conditional]) -> FloatArray:
    """Log of weight times density of every vector under every component, (N, g) float."""
    found = np.empty((len(vectors.values), len(model.weights)))
    constants = vectors.has.sum(axis=1) / 2 * math.log(2 * math.pi)
    for number, (root, offsets, gaps) in enumerate(given):
        whitened = multiplied(_inverse_factor(root), np.ascontiguousarray(offsets.T))
        squares = np.einsum("nr,nr->r", whitened, whitened)
        volumes = constants + np.log(root.diagonal()).sum()
        # The density of all entries, integrated over those that are missing.
        for (rows, _), (of_gap, below) in zip(vectors.gaps, gaps, strict=True):
            pulled = of_gap.T @ below
            squares[rows[:, 0]] -= np.einsum("lr,lr->r", pulled, pulled)
            volumes[rows[:, 0]] += np.log(of_gap.diagonal()).sum()
        weight = max(float(model.weights[number]), 1e-300)
        found[:, number] = math.log(weight) - volumes - squares / 2
    return found


def _expect(
    vectors: Vectors, shares: FloatArray, mean: FloatArray, given: Conditional
) -> tuple[FloatArray, FloatArray]:
    """Expected vectors, and the covariance of what is missing, summed with shares as weights."""
    completed, spread = vectors.values.copy(), np.zeros_like(given.root)
    for (rows, missing), (of_gap, below) in zip(vectors.gaps, given.gaps, strict=True):
        completed[rows, missing] = mean[missing] - below.T
        spread[missing[:, None], missing] += shares[rows].sum() * _inverse(of_gap)
    return completed, spread


def _maximise(
    vectors: Vectors,
    shares: FloatArray,
    model: Gaussians,
    given: Sequence[Conditional],
    prior: tuple[FloatArray, float, float],
) -> Gaussians:
    """One round: the mixture that makes the completed vectors most likely.

    The prior is what covariances are drawn towards (d, d), the number of vectors that it counts
    as, and the standard deviation that no direction falls below.
    """
    means, covariances = [], []
    towards, strength, floor = prior
    for number, share in enumerate(shares.T):
        completed, spread = _expect(vectors, share, model.means[number], given[number])
        mean = share @ completed + _UNSEEN * model.means[number]
        mean /= share.sum() + _UNSEEN
        offsets = completed - mean
        scatter = multiplied(offsets.T, share[:, None] * offsets) + spread
        scatter += (strength + _UNSEEN) * towards
        covariance = scatter / (share.sum() + strength + _UNSEEN)
        covariance[np.diag_indices_from(covariance)] += floor**2
        means.append(mean)
        covariances.append(covariance)
    totals = shares.sum(axis=0) + _UNSEEN
    return Gaussians(totals / totals.sum(), np.array(means), np.array(covariances))


# Compiled here, and so are products: BLAS shares such small matrices out among threads, which takes
# 30 times as long on a busy machine.
def _root(covariance: FloatArray) -> FloatArray:
    """The lower Cholesky factor."""
    root = np.tril(covariance)
    if not factorize(root):
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return root


def _inverse(root: FloatArray) -> FloatArray:
    """The inverse of the matrix that has the root."""
    half = _inverse_factor(root)
    return multiplied(half.T, half)


@fast_sums
def _inverse_factor(factor: FloatArray) -> FloatArray:
    """The inverse of the lower triangle that `factorize` left."""
    size = factor.shape[0]
    inverse = np.zeros((size, size))
    for i in range(size):
        scale = 1.0 / factor[i, i]
        for k in range(i):
            product = factor[i, k] * scale
            for m in range(k + 1):
                inverse[i, m] -= product * inverse[k, m]
        inverse[i, i] = scale
    return inverse


@fast_sums
def multiplied(first: FloatArray, second: FloatArray) -> FloatArray:
    """The matrix product (n, k) of (n, m) and (m, k), in one thread."""
    found = np.zeros((first.shape[0], second.shape[1]))
    for i in range(first.shape[0]):
        own = found[i]
        for j in range(second.shape[0]):
            share, other = first[i, j], second[j]
            for c in range(own.shape[0]):
                own[c] += share * other[c]
    return found
