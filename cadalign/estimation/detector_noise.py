"""Noise of a keypoint detector: standard deviations by score and keypoint, and their calibration.

Errors of keypoints are Gaussian, with a standard deviation that depends on the score and on the
keypoint, or belong to outliers, spread evenly over a disc about the object. Both are found by
expectation maximisation (Dempster, Laird, Rubin, 1977); the truth's own noise is taken off.
"""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray, as_floats, as_points
from cadalign.errors import InputError, quote
from cadalign.io.documents import Count, Document, Finite, NotNegative, Positive, read_document
from cadalign.io.evidence import ObservedImage
from cadalign.io.files import as_path, once_per_file, write_json
from cadalign.io.observation import Observation

if TYPE_CHECKING:
    from cadalign.datasets.detections.image_keypoints import ImageKeypoints

_LEAST_SIZE = 1.0  # of an object in the image [px]
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


@dataclass(frozen=True, eq=False)
class DetectorNoise:
    """Noise of a detector's keypoints, as `cadalign.calibrate_detector` finds it.

    Parameters
    ----------
    scores : (k,) float
        Rising scores at which ``sigmas`` are known; between them logarithms are interpolated,
        beyond them the outermost holds. One, where scores say nothing.
    sigmas : (k,) float
        Standard deviations there, falling: in ``unit``.
    unit : {"px", "size"}
        Pixels, or shares of the object's size: the longer side of its keypoints' box.
    factors : mapping of int or str to float
        Factors of single keypoints, by id or name; 1 for the others.
    outliers : float
        Share of keypoints that are outliers, about which ``sigmas`` say nothing.
    correlation : float
        Correlation between errors of two keypoints of an object. Estimates take errors for
        independent; what they have in common moves the translation, hardly the rotation.
    count : int
        Number of keypoints that it was calibrated with.

    Raises
    ------
    InputError
        If scores don't rise, a standard deviation is not positive, or numbers don't match.

    Examples
    --------
    >>> noise = DetectorNoise([0.2, 0.8], [8.0, 2.0], factors={"roof": 1.5})
    >>> noise.sigma([[0, 0], [90, 9]], scores=[0.5, 0.9], ids=["roof", "door"]).round(6).tolist()
    [6.0, 2.0]
    """

    scores: npt.ArrayLike
    sigmas: npt.ArrayLike
    unit: Literal["px", "size"] = "px"
    factors: Mapping[int | str, float] = field(default_factory=dict)
    outliers: float = 0.0
    correlation: float = 0.0
    count: int = 0

    def __post_init__(self) -> None:
        scores = as_floats(self.scores, name="scores", shape=(None,))
        sigmas = as_floats(self.sigmas, name="sigmas", shape=(len(scores),))
        if not len(scores) or (np.diff(scores) <= 0).any():
            raise InputError("do not rise", where="scores")
        factors = np.array(list(self.factors.values()), dtype=float)
        for name, values in (("sigmas", sigmas), ("factors", factors)):
            if not (values > 0).all():
                raise InputError("has values that are not positive", where=name)
        if self.unit not in ("px", "size"):
            what = f"{quote(self.unit)} is neither 'px' nor 'size'"
            raise InputError(what, where="unit")
        object.__setattr__(self, "scores", scores)
        object.__setattr__(self, "sigmas", sigmas)

    def sigma(
        self,
        points_2d: npt.ArrayLike,
        *,
        scores: npt.ArrayLike | None = None,
        ids: Sequence[Hashable] | None = None,
    ) -> FloatArray:
        """Standard deviations (n,) of an object's keypoints [px].

        Parameters
        ----------
        points_2d : (n, 2) float
            All keypoints of the object that were found [px].
        scores : (n,) float, optional
            The detector's; needed where the noise depends on them.
        ids : sequence of n int or str, optional
            Ids or names; those that are not known have the factor 1.

        Raises
        ------
        InputError
            If scores are needed and missing, or numbers don't match.
        """
        points = as_points(points_2d, name="points_2d", dimension=2)
        knots, sigmas = cast(FloatArray, self.scores), cast(FloatArray, self.sigmas)
        found = np.full(len(points), sigmas[0])
        if len(knots) > 1:
            if scores is None:
                what = "the detector's noise depends on the scores, which are missing"
                raise InputError(what, where="scores", fix="give the keypoints' scores")
            given = as_floats(scores, name="scores", shape=(len(points),))
            found = np.exp(np.interp(given, knots, np.log(sigmas)))
        if ids is not None:
            if len(ids) != len(points):
                raise InputError(f"{len(ids)} for {len(points)} keypoints", where="ids")
            found = found * [self.factors.get(cast("int | str", each), 1.0) for each in ids]
        return np.asarray(found * (size_of(points) if self.unit == "size" else 1.0))

    @property
    def _knots(self) -> list[tuple[float, float]]:
        scores, sigmas = cast(FloatArray, self.scores), cast(FloatArray, self.sigmas)
        return list(zip(scores.tolist(), sigmas.tolist(), strict=True))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the noise as JSON; files are called ``detector.noise``.

        Raises
        ------
        DataError
            If the file cannot be written.
        """
        knots = [{"score": score, "sigma": sigma} for score, sigma in self._knots]
        factors = [{"id": name, "factor": factor} for name, factor in self.factors.items()]
        plain = {name: getattr(self, name) for name in ("outliers", "correlation", "count")}
        document = {"unit": self.unit, "knots": knots, "factors": factors, **plain}
        write_json(as_path(path), document)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> DetectorNoise:
        """Read what `save` wrote.

        Raises
        ------
        DataError
            If the file cannot be read, or a field is missing or invalid; the message names both.
        """
        read = read_document(as_path(path), _NoiseFile)
        return cls(
            [knot.score for knot in read.knots],
            [knot.sigma for knot in read.knots],
            read.unit,
            {each.id: each.factor for each in read.factors},
            read.outliers,
            read.correlation,
            read.count,
        )

    def __str__(self) -> str:
        unit = "px" if self.unit == "px" else "of the object's size"
        by_score = ", ".join(f"{sigma:.3g} at score {score:.3g}" for score, sigma in self._knots)
        return (
            f"{self.count} keypoints: standard deviation {by_score} ({unit}); "
            f"{self.outliers:.1%} outliers, correlation {self.correlation:.2f}"
        )


class _NoiseKnot(Document):
    score: Finite
    sigma: Positive


class _NoiseFactor(Document):
    id: int | str
    factor: Positive


class _NoiseFile(Document):
    unit: Literal["px", "size"]
    knots: list[_NoiseKnot]
    factors: list[_NoiseFactor]
    outliers: NotNegative
    correlation: Finite
    count: Count


def with_noise(observation: Observation, path: Path) -> Observation:
    """The observation with the standard deviations that a noise file says of its keypoints."""
    noise = opened_noise(path)

    def sigma_of(image: ObservedImage) -> FloatArray:
        ids = image.names if image.names is not None else image.ids
        known = (
            None if ids is None else [each if isinstance(each, str) else int(each) for each in ids]
        )
        return noise.sigma(image.points_2d, scores=image.scores, ids=known)

    others = tuple(replace(image, sigma=sigma_of(image)) for image in observation.others)
    options = {name: each for name, each in observation.fit_options.items() if name != "sigma"}
    return replace(observation, sigma=sigma_of(observation), others=others, fit_options=options)


@once_per_file(4)
def opened_noise(path: Path) -> DetectorNoise:
    """`DetectorNoise.open`, once for a run over many observations."""
    return DetectorNoise.open(path)


def size_of(points: FloatArray) -> float:
    """Longer side of the box of keypoints (n, 2) [px]."""
    return max(float(np.ptp(points, axis=0).max()), _LEAST_SIZE) if len(points) else _LEAST_SIZE


def calibrate_detector(
    predictions: Sequence[ImageKeypoints], truth: Sequence[ImageKeypoints]
) -> DetectorNoise:
    """Noise of a detector from its keypoints and the true ones.

    Whether errors grow with the object in the image, and whether scores matter, is chosen by
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
    data = _errors_of(predictions, truth)
    if len(data.errors) < _LEAST:
        what = f"{len(data.errors)} keypoints are too few"
        raise InputError(what, where="predictions", fix=f"give at least {_LEAST}")
    units: tuple[Literal["px", "size"], ...] = ("px", "size")
    fits = [_fitted(data, unit, by_score) for unit in units for by_score in (False, True)]
    return min(fits, key=lambda each: each[0])[1]


class _DetectorErrors(NamedTuple):
    """Errors (n, 2) of all keypoints, and of each its object, score, id, size, truth's variance."""

    errors: FloatArray
    objects: IntArray
    scores: FloatArray | None
    ids: tuple[int | str | None, ...]
    sizes: FloatArray
    variances: FloatArray


def _errors_of(
    predictions: Sequence[ImageKeypoints], truth: Sequence[ImageKeypoints]
) -> _DetectorErrors:
    """The errors of all pairs that both have."""
    if len(predictions) != len(truth):
        what = f"{len(truth)} objects, but {len(predictions)} predictions"
        raise InputError(what, where="truth", fix="give the same objects in the same order")
    rows: list[tuple[object, ...]] = []
    for number, (seen, true) in enumerate(zip(predictions, truth, strict=True)):
        kept, places = _pairs(seen, true, number)
        errors = seen.points_2d[kept] - true.points_2d[places]
        scores = [np.nan] * len(kept) if seen.scores is None else seen.scores[kept]
        labels = seen.names or seen.ids or (None,) * len(seen)
        size = size_of(seen.points_2d[kept])
        variances = (np.zeros(len(true)) if true.sigma is None else true.sigma)[places] ** 2
        for k, row in enumerate(kept):
            rows.append((errors[k], number, scores[k], labels[row], size, variances[k]))
    columns: list[tuple[object, ...]] = list(zip(*rows, strict=True)) if rows else [()] * 6
    given, sizes, variances = (np.array(columns[k], dtype=float) for k in (2, 4, 5))
    return _DetectorErrors(
        np.array(columns[0], dtype=float).reshape(-1, 2),
        np.array(columns[1], dtype=np.int64),
        given if np.isfinite(given).all() else None,
        cast("tuple[int | str | None, ...]", columns[3]),
        sizes,
        variances,
    )


def _fitted(
    data: _DetectorErrors, unit: Literal["px", "size"], by_score: bool
) -> tuple[float, DetectorNoise]:
    """Expectation maximisation over standard deviations by score and keypoint, and outliers.

    Returns -2 log likelihood, with the logarithm of the data for each number, and the noise.
    """
    knots, weights = _hats(data.scores if by_score else None, len(data.errors))
    names = sorted({each for each in data.ids if each is not None}, key=str)
    place = {name: row for row, name in enumerate(names)}
    rows = np.array([place.get(each, -1) for each in cast("tuple[str]", data.ids)])
    squares = (data.errors**2).sum(axis=1)
    scale = data.sizes if unit == "size" else np.ones(len(data.sizes))
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
    correlation = _correlation(whitened, data.objects, core > _CORE)
    sigmas, count = np.exp(logs), len(squares)
    return cost, DetectorNoise(knots, sigmas, unit, known, share, correlation, count)


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
