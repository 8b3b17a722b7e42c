"""Noise of a keypoint detector: standard deviations by score and keypoint, in a file."""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.errors import InputError, quote
from cadalign.io.documents import Count, Document, Finite, NotNegative, Positive, read_document
from cadalign.io.evidence import ObservedImage
from cadalign.io.files import write_json
from cadalign.io.observation import Observation

_LEAST_SIZE = 1.0  # of an object in the image [px]


@dataclass(frozen=True, eq=False)
class DetectorNoise:
    """Noise of a detector's keypoints, as `cadalign.calibrate_detector` finds it.

    Parameters
    ----------
    scores : (k,) float
        Rising scores at which ``sigmas`` are known; between them logarithms are interpolated,
        beyond them the outermost holds. One, where scores tell nothing.
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

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the noise as JSON; files are called ``detector.noise``.

        Raises
        ------
        DataError
            If the file cannot be written.
        """
        factors = [{"id": name, "factor": factor} for name, factor in self.factors.items()]
        knots = zip(
            cast(FloatArray, self.scores).tolist(),
            cast(FloatArray, self.sigmas).tolist(),
            strict=True,
        )
        write_json(
            Path(path),
            {
                "unit": self.unit,
                "knots": [{"score": score, "sigma": sigma} for score, sigma in knots],
                "factors": factors,
                "outliers": self.outliers,
                "correlation": self.correlation,
                "count": self.count,
            },
        )

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> DetectorNoise:
        """Read what `save` wrote.

        Raises
        ------
        DataError
            If the file cannot be read, or a field is missing or invalid; the message names both.
        """
        read = read_document(Path(path), _NoiseFile)
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
        knots = zip(cast(FloatArray, self.scores), cast(FloatArray, self.sigmas), strict=True)
        by_score = ", ".join(f"{sigma:.3g} at score {score:.3g}" for score, sigma in knots)
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


@lru_cache(maxsize=4)
def opened_noise(path: Path) -> DetectorNoise:
    """`DetectorNoise.open`, once for a run over many observations."""
    return DetectorNoise.open(path)


def size_of(points: FloatArray) -> float:
    """Longer side of the box of keypoints (n, 2) [px]."""
    return max(float(np.ptp(points, axis=0).max()), _LEAST_SIZE) if len(points) else _LEAST_SIZE
