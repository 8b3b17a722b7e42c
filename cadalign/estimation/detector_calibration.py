"""Calibration of a keypoint detector: standard deviations by score, outliers, correlation.

Errors of keypoints are Gaussian, with a standard deviation that depends on the score and on the
keypoint, or belong to outliers, spread evenly over a disc about the object. Both are found by
expectation maximisation (Dempster, Laird, Rubin, 1977); the truth's own noise is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.errors import InputError
from cadalign.estimation.detector_noise import DetectorNoise, size_of

_ROUNDS = 200
_TOLERANCE = 1e-7
_PER_KNOT = 40  # keypoints that a knot of the score is worth
_MOST_KNOTS = 6
_LEAST = 20  # keypoints to calibrate with
_PRIOR_COUNT = 15.0  # keypoints that a factor of 1 of each keypoint is worth
_FIRST_OUTLIERS = 0.05
_MOST_OUTLIERS = 0.5
_LEAST_SIGMA = 1e-6  # over the median error
_CORE = 0.5  # probability of being no outlier at which a keypoint counts for the correlation


def calibrate_detector(
    predictions: Sequence[ImageKeypoints], truth: Sequence[ImageKeypoints]
) -> DetectorNoise:
    """Noise of a detector from its keypoints and the true ones.

    Whether errors grow with the object in the image, and whether scores tell anything, is chosen by
    the likelihood.

    Parameters
    ----------
    predictions : sequence of ImageKeypoints
        The detector's, of an object each, with scores where it has some:
        `cadalign.datasets.read_image_keypoints` reads files. Any number serves as score that rises
        with certainty, such as minus the logarithm of a heat map's spread. A score of 0 marks
        keypoints that were not found.
    truth : sequence of ImageKeypoints
        The true ones of the same objects, in the same order, paired by name or semantic id, or else
        by row; ``sigma`` is their own standard deviation [px].

    Returns
    -------
    DetectorNoise
        ``View(noise=)`` and ``cadalign fit --noise`` take it.

    Raises
    ------
    InputError
        If there are not as many objects, or fewer than 20 keypoints in all.

    Examples
    --------
    >>> from cadalign.datasets.detections.image_keypoints import ImageKeypoints
    >>> rng = np.random.default_rng(0)
    >>> true, seen = [], []
    >>> for _ in range(100):
    ...     points, scores = rng.uniform(0, 300, (8, 2)), rng.uniform(0, 1, 8)
    ...     true.append(ImageKeypoints(points))
    ...     errors = rng.normal(0, 1, (8, 2)) * np.where(scores > 0.5, 1.0, 4.0)[:, None]
    ...     seen.append(ImageKeypoints(points + errors, scores))
    >>> noise = calibrate_detector(seen, true)
    >>> noise.unit, noise.sigma(np.zeros((2, 2)), scores=[0.1, 0.9]).round().tolist()
    ('px', [4.0, 1.0])
    """
    data = _DetectorErrors.of(predictions, truth)
    if len(data.errors) < _LEAST:
        what = f"{len(data.errors)} keypoints are too few"
        raise InputError(what, where="predictions", fix=f"give at least {_LEAST}")
    fits = [_fitted(data.in_unit(unit), by_score) for unit in ("px", "size") for by_score in (0, 1)]
    return min(fits, key=lambda each: each.cost).noise(len(data.errors))


@dataclass(frozen=True, eq=False)
class _DetectorErrors:
    """Errors (n, 2) of all keypoints, and of each its object, score, id, size and truth's variance.

    ``scale`` (n,) is what a standard deviation of 1 is in pixels.
    """

    errors: FloatArray
    objects: IntArray
    scores: FloatArray | None
    ids: tuple[int | str | None, ...]
    sizes: FloatArray
    variances: FloatArray
    unit: Literal["px", "size"] = "px"

    @classmethod
    def of(
        cls, predictions: Sequence[ImageKeypoints], truth: Sequence[ImageKeypoints]
    ) -> _DetectorErrors:
        """The errors of all pairs that both have."""
        if len(predictions) != len(truth):
            what = f"{len(truth)} objects, but {len(predictions)} predictions"
            raise InputError(what, where="truth", fix="give the same objects in the same order")
        columns: list[list[object]] = [[], [], [], [], [], []]
        for number, (seen, true) in enumerate(zip(predictions, truth, strict=True)):
            kept, places = _pairs(seen, true, number)
            size = size_of(seen.points_2d[kept]) if len(kept) else 1.0
            labels = seen.names or seen.ids or (None,) * len(seen)
            own = np.zeros(len(true)) if true.sigma is None else true.sigma
            columns[0].extend(seen.points_2d[kept] - true.points_2d[places])
            columns[1].extend([number] * len(kept))
            columns[2].extend([np.nan] * len(kept) if seen.scores is None else seen.scores[kept])
            columns[3].extend(labels[row] for row in kept)
            columns[4].extend([size] * len(kept))
            columns[5].extend(own[places] ** 2)
        errors, objects, scores, ids, sizes, variances = columns
        given = np.array(scores, dtype=float)
        return cls(
            np.array(errors, dtype=float).reshape(-1, 2),
            np.array(objects, dtype=np.int64),
            None if not np.isfinite(given).all() else given,
            tuple(cast("list[int | str | None]", ids)),
            np.array(sizes, dtype=float),
            np.array(variances, dtype=float),
        )

    def in_unit(self, unit: Literal["px", "size"] | str) -> _DetectorErrors:
        """The same errors in another unit."""
        return replace(self, unit=cast('Literal["px", "size"]', unit))

    @property
    def scale(self) -> FloatArray:
        """Pixels (n,) of a standard deviation of 1."""
        return self.sizes if self.unit == "size" else np.ones(len(self.sizes))


@dataclass(frozen=True, eq=False)
class _FittedNoise:
    """Noise with its cost: -2 log likelihood, and the logarithm of the data for each number."""

    data: _DetectorErrors
    knots: FloatArray
    sigmas: FloatArray
    factors: dict[int | str, float]
    outliers: float
    core: FloatArray  # (n,) probabilities of being no outlier
    whitened: FloatArray  # (n, 2)
    cost: float

    def noise(self, count: int) -> DetectorNoise:
        """The noise, with the correlation within objects."""
        return DetectorNoise(
            self.knots,
            self.sigmas,
            self.data.unit,
            self.factors,
            self.outliers,
            _correlation(self.whitened, self.data.objects, self.core > _CORE),
            count,
        )


def _fitted(data: _DetectorErrors, by_score: int) -> _FittedNoise:
    """Expectation maximisation over standard deviations by score and keypoint, and outliers."""
    knots, weights = _hats(data.scores if by_score else None, len(data.errors))
    names = sorted({each for each in data.ids if each is not None}, key=str)
    place = {name: row for row, name in enumerate(names)}
    rows = np.array([place.get(each, -1) for each in cast("tuple[str]", data.ids)])
    squares, scale = (data.errors**2).sum(axis=1), data.scale
    start = np.sqrt(max(np.median(squares / scale**2) / 1.386, 1e-12))
    logs, factors = np.full(len(knots), np.log(start)), np.ones(len(names) + 1)
    share, cost, core = _FIRST_OUTLIERS, np.inf, np.ones(len(squares))
    whole = squares
    for _ in range(_ROUNDS):
        own = np.exp(2 * weights @ logs) * factors[rows] ** 2 * scale**2
        whole = own + data.variances
        inside = (1 - share) * np.exp(-squares / (2 * whole)) / (2 * np.pi * whole)
        outside = share / (np.pi * np.maximum(data.sizes, np.sqrt(whole)) ** 2)
        core = inside / (inside + outside)
        before, cost = cost, float(-2 * np.log(inside + outside).sum())
        if before - cost < _TOLERANCE * abs(cost):
            break
        share = min(float((1 - core).mean()), _MOST_OUTLIERS)
        # The detector's part of each squared error, given the truth's variance.
        part = (own / whole) ** 2 * squares / 2 + own * data.variances / whole
        ratios = part / own
        for k in range(len(knots)):
            weight = core * weights[:, k]
            if weight.sum() > 0:
                logs[k] += 0.5 * np.log(max((weight @ ratios) / weight.sum(), _LEAST_SIGMA))
        logs = _falling(logs, (core[:, None] * weights).sum(axis=0))
        for row in range(len(names)):
            mine = core[rows == row]
            total = mine @ ratios[rows == row] + _PRIOR_COUNT / factors[row] ** 2
            factors[row] *= np.sqrt(total / (mine.sum() + _PRIOR_COUNT))
    cost += np.log(len(squares)) * len(knots)
    known = {name: float(factors[row]) for name, row in place.items()}
    whitened = data.errors / np.sqrt(whole)[:, None]
    return _FittedNoise(data, knots, np.exp(logs), known, share, core, whitened, cost)


def _hats(scores: FloatArray | None, count: int) -> tuple[FloatArray, FloatArray]:
    """Knots (k,) at quantiles of the scores, and weights (n, k) of linear interpolation."""
    if scores is None or np.ptp(scores) == 0:
        return np.zeros(1), np.ones((count, 1))
    number = int(np.clip(count // _PER_KNOT, 2, _MOST_KNOTS))
    knots = np.unique(np.quantile(scores, (np.arange(number) + 0.5) / number))
    if len(knots) < 2:
        return np.zeros(1), np.ones((count, 1))
    return knots, np.stack([np.interp(scores, knots, row) for row in np.eye(len(knots))], axis=1)


def _falling(values: FloatArray, weights: FloatArray) -> FloatArray:
    """The nearest values that do not rise, by pooling adjacent violators."""
    pools: list[list[float]] = []  # mean, weight, number
    for value, weight in zip(values.tolist(), np.maximum(weights, 1e-9).tolist(), strict=True):
        pools.append([value, weight, 1])
        while len(pools) > 1 and pools[-1][0] > pools[-2][0]:
            mean, total, number = pools.pop()
            last = pools[-1]
            last[0] = (last[0] * last[1] + mean * total) / (last[1] + total)
            last[1] += total
            last[2] += number
    return np.concatenate([np.full(int(number), mean) for mean, _, number in pools])


def _correlation(whitened: FloatArray, objects: IntArray, kept: BoolArray) -> float:
    """Mean product of whitened errors of two keypoints of an object, over their mean square."""
    products = pairs = 0.0
    for number in np.unique(objects[kept]):
        own = whitened[kept & (objects == number)]
        products += float(((own.sum(axis=0) ** 2) - (own**2).sum(axis=0)).sum())
        pairs += 2 * len(own) * (len(own) - 1)
    square = float((whitened[kept] ** 2).mean()) if kept.any() else 1.0
    return float(np.clip(products / pairs / square, -1, 1)) if pairs and square > 0 else 0.0


def _pairs(seen: ImageKeypoints, true: ImageKeypoints, number: int) -> tuple[IntArray, IntArray]:
    """Rows of the same keypoints in a prediction and its truth, found in both."""
    found = np.ones(len(seen), dtype=bool) if seen.scores is None else seen.scores > 0
    known = np.ones(len(true), dtype=bool) if true.scores is None else true.scores > 0
    for name in ("names", "ids"):
        ours, theirs = getattr(seen, name), getattr(true, name)
        if ours is not None and theirs is not None:
            place = {label: row for row, label in enumerate(theirs) if known[row]}
            rows = [
                (k, place[label]) for k, label in enumerate(ours) if found[k] and label in place
            ]
            pairs = np.array(rows, dtype=np.int64).reshape(-1, 2)
            return pairs[:, 0], pairs[:, 1]
    if len(seen) != len(true):
        what = f"{len(seen)} keypoints, but the truth has {len(true)}, and they share no names"
        raise InputError(what, where=f"predictions[{number}]")
    both = np.flatnonzero(found & known)
    return both, both
