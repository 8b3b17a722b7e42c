"""Colours inside and outside of an outline, and where along a line across it the colours change.

The statistics of region-based tracking: M. Stoiber, M. Pfanne, K. H. Strobl, R. Triebel,
A. Albu-Schaeffer, "SRT3D: A sparse region-based 3D object tracking approach for the real world",
IJCV 130, 2022 (arXiv 2110.12715). Histograms of the colours on both sides of the predicted outline
give the probability that a pixel is the object's; along a line, those of its pixels together with a
smoothed step give the posterior of the place where the line leaves the object.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray

_BINS = 16  # of a channel
_FLOOR = 1e-4  # share of the colours that were never seen
_AMPLITUDE = 0.43  # of the step: the rest of 0.5 is noise that no histogram knows
_SLOPE = 0.6  # half width of the step, in steps along the line
_LEAST_PRECISION = 0.1  # of a line that tells a place, over that of the prior
_OF_STEPS = 1 / 12  # variance of a place within a step
_LEAST_SIDE = 2.0  # steps on either side of an edge
_QUANTUM = 3.0  # variance of three channels by their quantisation and a little noise


def bins_of(colors: npt.NDArray[np.floating[Any]]) -> IntArray:
    """Numbers (...) of the histogram's bins of colours (..., 3) from 0 to 255."""
    cells = np.clip(np.multiply(colors, _BINS / 256), 0, _BINS - 1).astype(np.int64)
    return np.asarray((cells[..., 0] * _BINS + cells[..., 1]) * _BINS + cells[..., 2])


def _histogram(bins: IntArray) -> FloatArray:
    """Shares of the colours by bins, smoothed over neighbouring ones."""
    counts = np.bincount(bins, minlength=_BINS**3).astype(np.float64).reshape((_BINS,) * 3)
    for axis in range(3):
        padded = np.pad(counts, [(int(a == axis),) * 2 for a in range(3)], mode="edge")
        low, middle, high = (
            np.take(padded, np.arange(shift, shift + _BINS), axis) for shift in range(3)
        )
        counts = (low + 2 * middle + high) / 4
    shares = counts.ravel() / max(counts.sum(), 1.0)
    return np.asarray((1 - _FLOOR) * shares + _FLOOR / _BINS**3)


class Regions(NamedTuple):
    """Colours on both sides of an outline.

    ``odds`` are, by bins, the probability of the object minus that of the background; ``contrast``
    is the mutual information of side and colour [nats], 0 without any, log 2 at most.
    """

    odds: FloatArray
    contrast: float


def regions_of(inside: IntArray, outside: IntArray) -> Regions:
    """Learn from the bins of the colours inside and outside."""
    own, other = _histogram(inside), _histogram(outside)
    both = (own + other) / 2
    contrast = (own * np.log(own / both) + other * np.log(other / both)).sum() / 2
    return Regions((own - other) / (2 * both), float(contrast))


class Crossings(NamedTuple):
    """Places at which S lines leave the object, in steps outwards from their middles.

    ``places`` (S,) and ``variances`` (S,), infinite where a line tells nothing.
    """

    places: FloatArray
    variances: FloatArray


def crossings_of(odds: FloatArray, valid: BoolArray, edges: FloatArray) -> Crossings:
    """Find where the colours along lines change from the object's to the background's.

    ``odds`` (S, 2 K + 1) are those of `Regions` at steps from the inside outwards, of which
    ``valid`` ones count; ``edges`` (S, 2 K + 1) are further log likelihoods of the places. The
    posterior is taken relative to the uniform prior on the line, so that a line without contrast
    has an infinite variance, and one with several crossings a large one.
    """
    count = odds.shape[1]
    steps = np.arange(count) - count // 2
    gaps = steps[:, None] - steps  # of the crossing (rows) from the pixels (columns)
    step = _AMPLITUDE * np.tanh(gaps / (2 * _SLOPE))
    known = np.where(valid, odds, 0.0)
    logs = edges + np.log(0.5 + step * known[:, None, :]).sum(axis=2)
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
    return Crossings(np.where(is_told, places, 0.0), np.where(is_told, 1 / safe, np.inf))


def edges_of(colors: FloatArray, valid: BoolArray, step: float) -> FloatArray:
    """Log likelihoods (S, 2 K + 1) of a change of the colours (S, 2 K + 1, 3) at each step.

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
    # A line of which one side is unknown tells no edge.
    error = squares[:, None] - np.where(usable, between, np.inf).min(axis=1, keepdims=True)
    error = np.where(usable, squares[:, None] - between, error) + _QUANTUM * total
    found = -total * min(step, 1.0) / 2 * np.log(np.maximum(error, 1e-9))
    return np.where(usable.any(axis=1, keepdims=True), found, 0.0)


def _sums_before(values: FloatArray) -> FloatArray:
    """Sums along lines (S, 2 K + 1, ...) before each step, which itself counts half."""
    return np.asarray(np.cumsum(values, axis=1) - values / 2)
