"""Mixtures of Gaussians, learned from vectors with missing entries.

Expectation maximisation as in Ghahramani and Jordan, "Supervised learning from incomplete data via
an EM approach", NIPS 1994. A prior draws each covariance towards a common one, for components of
few vectors.
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

    def widen(self, sigma: float) -> Gaussians:
        """Add independent noise to every entry; returns the new distribution."""
        noise = sigma**2 * np.eye(self.means.shape[1])
        return Gaussians(self.weights, self.means, self.covariances + noise)


class Conditional(NamedTuple):
    """A Gaussian conditioned on the known entries of vectors.

    ``root`` (d, d) is the lower Cholesky factor of the covariance, ``offsets`` (N, d) are the
    entries minus the mean, 0 if missing. For each of `Vectors.gaps`, ``gaps`` holds the Cholesky
    factor (l, l) of the missing entries' conditional precision, and the mean minus their
    conditional expectation (l, r).
    """

    root: FloatArray
    offsets: FloatArray
    gaps: tuple[tuple[FloatArray, FloatArray], ...]


@dataclass(frozen=True, eq=False)
class Vectors:
    """Weighted vectors with missing entries."""

    values: FloatArray  # (N, d), NaN if missing; every vector has an entry
    weights: FloatArray  # (N,)

    @cached_property
    def has(self) -> BoolArray:
        """Mask of the known entries, (N, d)."""
        return ~np.isnan(self.values)

    @cached_property
    def gaps(self) -> tuple[tuple[IntArray, IntArray], ...]:
        """Groups of vectors that lack the same entries: rows (r, 1) and missing entries (l,)."""
        lacking = np.flatnonzero(~self.has.all(axis=1))
        bits = np.packbits(self.has[lacking], axis=1)  # sorted faster than the entries themselves
        _, first, kind_of = np.unique(bits, axis=0, return_index=True, return_inverse=True)
        return tuple(
            (lacking[kind_of.ravel() == kind][:, None], np.flatnonzero(~self.has[row]))
            for kind, row in enumerate(lacking[first].tolist())
        )

    def offsets(self, mean: FloatArray) -> FloatArray:
        """Subtract a mean (d,) from the entries, (N, d); 0 if missing."""
        return np.where(self.has, self.values - mean, 0.0)

    @cached_property
    def mean(self) -> FloatArray:
        """Mean of each entry, (d,); for entries that no vector has, the mean of all entries."""
        totals = np.where(self.has, self.weights[:, None], 0.0).sum(axis=0)
        sums = (self.weights[:, None] * np.where(self.has, self.values, 0.0)).sum(axis=0)
        overall = sums.sum() / totals.sum()
        return np.asarray(np.where(totals > 0, sums / np.where(totals > 0, totals, 1.0), overall))

    @property
    def variance(self) -> float:
        """Mean squared distance of the entries from their means."""
        return float(np.nanmean((self.values - self.mean) ** 2))

    def complete(self, model: Gaussians) -> FloatArray:
        """Fill missing entries with their expectations under the likeliest component, (N, d)."""
        given, unweighted = _conditionals(self, model), np.zeros(len(self.values))
        likeliest = _log_densities(self, model, given).argmax(axis=1)
        pairs = zip(model.means, given, strict=True)
        every = np.array([_expect(self, unweighted, mean, each)[0] for mean, each in pairs])
        return np.asarray(every[likeliest, np.arange(len(likeliest))])


def log_likelihoods(vectors: Vectors, model: Gaussians) -> FloatArray:
    """Log density of each vector's known entries under a mixture, (N,) float."""
    densities = _log_densities(vectors, model, _conditionals(vectors, model))
    return np.asarray(np.logaddexp.reduce(densities, axis=1))


def learn_gaussian(vectors: Vectors, *, strength: float, floor: float, rounds: int) -> Gaussians:
    """Learn one Gaussian; its covariance is drawn towards a multiple of the identity."""
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
    """Learn a mixture from an initial clustering.

    ``labels`` (N,) are the vectors' initial components, ``common`` is the Gaussian of all vectors,
    the initial value of each component. Covariances are drawn towards their mean over the
    components. For ``strength`` and ``floor`` see `_maximise`.
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
    """Condition every component on the known entries."""
    found = []
    for mean, covariance in zip(model.means, model.covariances, strict=True):
        root, offsets, gaps = _root(covariance), vectors.offsets(mean), []
        if vectors.gaps:
            precision = _inverse(root)
            pulled = multiply(offsets, precision)
            for rows, missing in vectors.gaps:
                of_gap = _root(precision[missing[:, None], missing])
                below = np.array(pulled[rows, missing].T, order="C")
                solve_factor_rows(of_gap, below)
                gaps.append((of_gap, below))
        found.append(Conditional(root, offsets, tuple(gaps)))
    return found


def _log_densities(vectors: Vectors, model: Gaussians, given: Sequence[Conditional]) -> FloatArray:
    """Log of weight times density of each vector under each component, (N, g) float."""
    found = np.empty((len(vectors.values), len(model.weights)))
    constants = vectors.has.sum(axis=1) / 2 * math.log(2 * math.pi)
    for number, (root, offsets, gaps) in enumerate(given):
        whitened = multiply(_inverse_factor(root), np.ascontiguousarray(offsets.T))
        squares = np.einsum("nr,nr->r", whitened, whitened)
        volumes = constants + np.log(root.diagonal()).sum()
        # The density of all entries, integrated over the missing ones.
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
    """Expected vectors (N, d), and the sum, weighted by shares, of their covariances (d, d)."""
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
    """Maximisation step: the mixture with the largest likelihood of the completed vectors.

    ``prior`` is the covariance (d, d) that covariances are drawn towards, its strength as a number
    of vectors, and the least standard deviation in any direction.
    """
    means, covariances = [], []
    towards, strength, floor = prior
    for number, share in enumerate(shares.T):
        completed, spread = _expect(vectors, share, model.means[number], given[number])
        mean = share @ completed + _UNSEEN * model.means[number]
        mean /= share.sum() + _UNSEEN
        offsets = completed - mean
        scatter = multiply(offsets.T, share[:, None] * offsets) + spread
        scatter += (strength + _UNSEEN) * towards
        covariance = scatter / (share.sum() + strength + _UNSEEN)
        covariance[np.diag_indices_from(covariance)] += floor**2
        means.append(mean)
        covariances.append(covariance)
    totals = shares.sum(axis=0) + _UNSEEN
    return Gaussians(totals / totals.sum(), np.array(means), np.array(covariances))


# These and products are compiled, since BLAS uses threads even for such small matrices, which is
# slow on a busy machine.
def _root(covariance: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a covariance."""
    root = np.tril(covariance)
    if not factorize(root):
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return root


def _inverse(root: FloatArray) -> FloatArray:
    """Inverse of the matrix with the given Cholesky factor."""
    half = _inverse_factor(root)
    return multiply(half.T, half)


@fast_sums
def _inverse_factor(factor: FloatArray) -> FloatArray:
    """Inverse of the lower triangle of a factor from `factorize`."""
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
def multiply(first: FloatArray, second: FloatArray) -> FloatArray:
    """Matrix product (n, k) of (n, m) and (m, k), in one thread."""
    found = np.zeros((first.shape[0], second.shape[1]))
    for i in range(first.shape[0]):
        own = found[i]
        for j in range(second.shape[0]):
            share, other = first[i, j], second[j]
            for c in range(own.shape[0]):
                own[c] += share * other[c]
    return found
