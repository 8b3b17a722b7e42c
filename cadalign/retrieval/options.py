"""Options of `cadalign.Library.retrieve`, and the likelihood behind the ranking.

A model of the library is scored by the likelihood of everything in the image, under these
assumptions:

- A keypoint of the object is marked in the image with the probability ``1 - missing_prob``,
  independently of the others; it may be hidden, or overlooked.
- A marked keypoint lies at the projection of the model's keypoint, with Gaussian noise of the
  standard deviation ``sigma``, to which ``shape_sigma`` adds the differences of shape. A robust
  loss takes the place of the squared error.
- An image shows ``spurious`` keypoints, on average, that the object does not have, anywhere in the
  image with equal density: each costs ``log(spurious / area)``.
- The logarithms of the stretches along y and z are Gaussian about zero, with the standard deviation
  ``stretch_sigma``, within 1/4 and 4.

So with N the number of shared keypoints, their errors r_i whitened by their covariances C_i, m the
number of the model's keypoints that the image lacks and e of the image's that the model lacks::

    log-likelihood = sum over the shared [log(1 - missing_prob) - log(2 pi) - log det(C_i) / 2
                                          - |r_i|^2 / 2]
                     + m log(missing_prob) + e log(spurious / area)
                     + log density of the stretches

at the pose and stretch that maximise it. A model that lacks keypoints of the image has fewer errors
to explain, but each of them costs some 15 units; each keypoint of a model that the image does not
show costs 0.7.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import DataError, InputError
from cadalign.estimation.options import FitOptions, Sigma
from cadalign.io.documents import in_file
from cadalign.io.files import once_per_file
from cadalign.io.observation import Observation, ObservationChanges
from cadalign.io.observation_file import fill_xyz

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.shapes.model import ShapeModel

logger = logging.getLogger("cadalign")


@dataclass(frozen=True)
class RetrievalOptions:
    """Options of a retrieval."""

    sigma: Sigma | None = 1.0
    """Standard deviation of the keypoints [px], one per keypoint, or a 2 x 2 covariance per
    keypoint."""
    loss: str = "linear"
    """Loss on the length of a whitened residual: linear (squared), huber or cauchy; the robust ones
    tolerate outliers."""
    loss_scale: float = 2.0
    """Length at which a robust loss begins to bend [sigma]."""
    stretch: str | None = None
    """Axes whose scale is estimated: by default both unknown ones; one of them, such as "y"; or
    "none"."""
    top: int = 10
    """Largest number of matches to return."""
    category: str | None = None
    """Name or synset id of the only category to compare with; by default all."""
    shape_sigma: float = 0.0
    """Distance of a model's keypoints from the object's, as a share of the extent of the keypoints
    in the image: above 0, say 0.03, for libraries with only similar models."""
    stretch_sigma: float = 0.4
    """Standard deviation of a Gaussian prior on the logarithm of each stretch."""
    missing_prob: float = 0.5
    """Probability that a keypoint of the object is not marked in the image."""
    spurious: float = 0.01
    """Average number of keypoints in an image that the object does not have."""
    none_prior: float = 0.5
    """Probability, before an image is seen, that the object is none of the library's models."""

    def __post_init__(self) -> None:
        if not isinstance(self.top, int) or self.top < 1:
            raise InputError(f"must be a whole number >= 1, not {self.top!r}", where="top")
        if self.sigma is None:
            fix = "give pixels, and shape_sigma where shapes differ"
            raise InputError("the noise must be known to compare models", where="sigma", fix=fix)
        is_share = 1e-9 <= self.missing_prob <= 1 - 1e-9
        for name, is_valid, rule in (
            ("shape_sigma", 0 <= self.shape_sigma < math.inf, ">= 0"),
            ("missing_prob", is_share, "between 0 and 1, both excluded"),
            ("spurious", 1e-9 <= self.spurious < math.inf, "> 0"),
            ("none_prior", 0 <= self.none_prior < 1, "between 0 and 1, the latter excluded"),
        ):
            if not is_valid:
                raise InputError(f"must be {rule}, not {getattr(self, name)}", where=name)
        _ = self.fitting  # checks the options that it shares with a fit

    @property
    def fitting(self) -> FitOptions:
        """Options of the fit of each model; its sigma is not used."""
        return FitOptions(
            loss=self.loss,
            loss_scale=self.loss_scale,
            stretch=self.stretch,
            stretch_sigma=self.stretch_sigma,
        )


@dataclass(frozen=True, kw_only=True)
class ObservationRetrieval:
    """Settings of the retrieval of an observation's model."""

    library: Path
    """File that `cadalign library build` wrote."""
    shape: Path | None = None
    """File that `cadalign shape learn` wrote: ranks its category's models by the shape estimated
    from the keypoints, for objects that are not in the library."""
    sigma: float | None = None
    """Standard deviation of the keypoints [px]; by default the file's, or 1."""
    ranking: RetrievalOptions = field(default_factory=RetrievalOptions)

    def opened(self) -> tuple[Library, ShapeModel | None]:
        """The library and the shape, which runs use again and again; DataError if unreadable."""
        return _library(self.library), None if self.shape is None else _shape(self.shape)

    def read(
        self, data: Any, where: str, *, folder: Path, changes: ObservationChanges
    ) -> Observation:
        """Read the parsed form of an observation, with changes, whose keypoints need no xyz."""
        with in_file(where):
            seen = Observation.from_dict(fill_xyz(data), folder=folder)
        return changes.applied_to(seen, where)

    def with_ids(self, seen: Observation, where: str) -> Observation:
        """The observation with the library's semantic ids, by names where it has none itself.

        Raises
        ------
        DataError
            If the keypoints have neither, or there are none.
        InputError
            If the library has no such names.
        """
        if seen.ids is not None and len(seen.points_2d):
            return seen
        with in_file(where):
            if not len(seen.points_2d):
                raise DataError("there are no keypoints")
            if seen.names is None:
                fix = "give each the id, or the name, of the library's models for it"
                raise DataError("the keypoints have no semantic_id and no name", fix=fix)
            return replace(seen, ids=self.opened()[0].ids_of(seen.names))

    def retrieve(self, seen: Observation, where: str, *, workers: int = -1) -> list[Match]:
        """Rank the library's models by an observation `with_ids`; see `Library.retrieve`."""
        if seen.others:
            said = "%s: models are ranked by the first of its %d photos alone"
            logger.warning(said, where, len(seen.views))
        library, shape = self.opened()
        assert seen.ids is not None
        stated = 1.0 if seen.sigma is None else seen.sigma
        sigma = stated if self.sigma is None else self.sigma
        return library.retrieve(
            seen.points_2d,
            seen.ids,
            seen.camera,
            **vars(replace(self.ranking, sigma=sigma)),
            shape=shape,
            workers=workers,
        )


@once_per_file(4)
def _library(path: Path) -> Library:
    from cadalign.retrieval.library import Library  # only here: help of a command needs none

    return Library.open(path)


@once_per_file(4)
def _shape(path: Path) -> ShapeModel:
    from cadalign.shapes.model import ShapeModel  # not for help of a command

    return ShapeModel.open(path)
