"""Places along a line where the colours of a photo change from the object to others.

The statistics of region-based tracking: M. Stoiber, M. Pfanne, K. H. Strobl, R. Triebel,
A. Albu-Schaeffer, "SRT3D: A sparse region-based 3D object tracking approach for the real world",
IJCV 130, 2022 (arXiv 2110.12715). Histograms of the colours on both sides of the predicted outline
give the probability that a pixel is the object's; along a line, those of its pixels together with a
smoothed step give the posterior of the place where the line leaves the object.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.io.images import ByteImage

_BINS = 16  # of a channel
_FLOOR = 1e-4  # share of the colours that were never seen
_AMPLITUDE = 0.43  # of the step: the rest of 0.5 is noise that no histogram knows
_SLOPE = 0.6  # half width of the step, in steps along the line
_LEAST_PRECISION = 0.1  # of a line that has a place, over that of the prior
_OF_STEPS = 1 / 12  # variance of a place within a step
_LEAST_SIDE = 2.0  # steps on either side of an edge
_QUANTUM = 3.0  # variance of three channels by their quantisation and a little noise
_NEIGHBOUR = 0.45  # weight of a neighbour's log likelihoods
_STRAY = 1e-3  # probability of a crossing anywhere on a line, beside its colours


def bins_of(colors: ByteImage) -> IntArray:
    """Numbers (...) of the histogram's bins of colours (..., 3)."""
    cells = (colors // (256 // _BINS)).astype(np.int64)
    return np.asarray((cells[..., 0] * _BINS + cells[..., 1]) * _BINS + cells[..., 2])


_PADDED = np.pad(np.eye(_BINS), [(1, 1), (0, 0)], mode="edge")
_SMOOTHING = (_PADDED[:-2] + 2 * _PADDED[1:-1] + _PADDED[2:]) / 4  # of bins, by neighbouring ones


def _histogram(bins: IntArray) -> FloatArray:
    """Shares of the colours by bins, smoothed over neighbouring ones."""
    counts = np.bincount(bins, minlength=_BINS**3).astype(np.float64)
    for _ in range(3):  # of red, green, and blue: each is the last axis once
        counts = (_SMOOTHING @ counts.reshape(_BINS, -1)).T
    shares = counts.ravel() / max(counts.sum(), 1.0)
    return np.asarray((1 - _FLOOR) * shares + _FLOOR / _BINS**3)


def regions_of(inside: IntArray, outside: IntArray) -> tuple[FloatArray, float]:
    """Learn from the bins of the colours inside and outside: odds and contrast.

    The odds are, by bins, the probability of the object minus that of the background; the contrast
    is the mutual information of side and colour [nats], 0 without any, log 2 at most.
    """
    own, other = _histogram(inside), _histogram(outside)
    both = (own + other) / 2
    contrast = (own * np.log(own / both) + other * np.log(other / both)).sum() / 2
    return (own - other) / (2 * both), float(contrast)


def changes_of(odds: FloatArray, valid: BoolArray) -> FloatArray:
    """Log likelihoods (S, 2 K + 1) of a change from the object's colours to others at each step.

    ``odds`` (S, 2 K + 1) are those of `regions_of` at steps from the inside outwards, of which
    ``valid`` ones count.
    """
    steps = np.arange(odds.shape[1])
    gaps = steps[:, None] - steps  # of the crossing (rows) from the pixels (columns)
    step = _AMPLITUDE * np.tanh(gaps / (2 * _SLOPE))
    known = np.where(valid, odds, 0.0)
    return np.asarray(np.log(0.5 + step * known[:, None, :]).sum(axis=2))


def with_neighbours(logs: FloatArray, are_neighbours: BoolArray) -> FloatArray:
    """Add a share of the log likelihoods (S, 2 K + 1) of the next lines along the outline.

    Near its place, an outline is displaced by nearly the same at neighbouring lines, so that these
    help to choose between several crossings. Their colours are independent in part: the sum counts
    by the root of its weights. ``are_neighbours`` (S - 1,) is true where a line and the next one
    are.
    """
    total = np.logaddexp.reduce(logs, axis=1, keepdims=True)
    bounded = np.logaddexp(logs - total, np.log(_STRAY / logs.shape[1]))
    shares = _NEIGHBOUR * are_neighbours[:, None]
    found, weights = bounded.copy(), np.ones((len(bounded), 1))
    for own, other in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
        found[own] += shares * bounded[other]
        weights[own] += shares
    return np.asarray(found / np.sqrt(weights))


def crossings_of(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find the places where lines leave the object from the log likelihoods (S, 2 K + 1) of these.

    Returns places (S,), in steps outwards from the lines' middles, and their variances. The
    posterior is taken relative to the uniform prior on the line, so that a line without contrast
    has an infinite variance, and one with several crossings a large one.
    """
    count = logs.shape[1]
    steps = np.arange(count) - count // 2
    likely = np.exp(logs - logs.max(axis=1, keepdims=True))
    likely /= likely.sum(axis=1, keepdims=True)
    mean = likely @ steps
    variance = likely @ steps**2 - mean**2 + _OF_STEPS
    prior = 1 / float((steps**2).mean())
    precision = 1 / variance - prior
    is_told = precision > _LEAST_PRECISION * prior
    safe = np.where(is_told, precision, 1.0)
    places = mean / variance / safe
    is_told &= np.abs(places) < count / 2
    return np.where(is_told, places, 0.0), np.where(is_told, 1 / safe, np.inf)


def edges_of(colors: FloatArray, valid: BoolArray, step: float) -> FloatArray:
    """Log likelihoods (S, 2 K + 1) of a change of the colours (S, 2 K + 1, c) at each step.

    On both sides of the change the colours are constant but for noise of unknown level: with the
    sum E of squares about both means, the likelihood is E to the power of -n / 2 for n pixels. A
    ``step`` is so many pixels long.
    """
    weights = valid.astype(np.float64)
    values = weights[..., None] * colors
    total = weights.sum(axis=1, keepdims=True)
    before, first = _sums_before(weights), _sums_before(values)
    after, second = total - before, values.sum(axis=1, keepdims=True) - first
    usable = (before >= _LEAST_SIDE) & (after >= _LEAST_SIDE)
    between = (first**2).sum(axis=2) / np.where(usable, before, 1.0)
    between += (second**2).sum(axis=2) / np.where(usable, after, 1.0)
    squares = (values * colors).sum(axis=(1, 2))
    # A line of which one side is unknown has no edge.
    error = squares[:, None] - np.where(usable, between, np.inf).min(axis=1, keepdims=True)
    error = np.where(usable, squares[:, None] - between, error) + _QUANTUM * total
    found = -total * min(step, 1.0) / 2 * np.log(np.maximum(error, 1e-9))
    return np.where(usable.any(axis=1, keepdims=True), found, 0.0)


def _sums_before(values: FloatArray) -> FloatArray:
    """Sums along lines (S, 2 K + 1, ...) before each step, which itself counts half."""
    return np.asarray(np.cumsum(values, axis=1) - values / 2)
