"""Keypoints of one view with the alignment that fits them, its alternatives, and the effort."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.alignment import Alignment, Box, extent
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another estimate that the evidence cannot tell from the best one.

    Parameters
    ----------
    alignment : Alignment
        In the first view's camera.
    relative_likelihood : float
        Its likelihood over that of the best one, 1 for an equally good one.
    camera : Camera
        The camera that goes with it; the best one's, unless the focal length was estimated.
    points_3d : (m, 3) float
        Its keypoints in the model's frame.
    own_bounds : (2, 3) float, optional
        Its box in the model's frame; None for that of the keypoints.
    """

    alignment: Alignment
    relative_likelihood: float
    camera: Camera
    points_3d: FloatArray
    own_bounds: FloatArray | None = field(default=None, repr=False)

    @property
    def bounds(self) -> FloatArray:
        """Its box (2, 3) in the model's frame."""
        return extent(self.points_3d) if self.own_bounds is None else self.own_bounds

    @property
    def box(self) -> Box:
        """Its box in the first camera's frame."""
        return Box.from_model(self.bounds, self.alignment)


@dataclass(frozen=True)
class FitStats:
    """Effort of an estimate.

    Parameters
    ----------
    iterations : int
        Refinement steps over all starts; samples, where inliers were searched for.
    hypotheses : int
        Alignments from which a refinement could start.
    seconds : float
    inlier_ratio : float, optional
        Share of the keypoints that were kept, where they were searched for.
    score : float, optional
        Sum of squared errors, each at most the threshold's square [px^2], of the robust search.
    """

    iterations: int
    hypotheses: int
    seconds: float
    inlier_ratio: float | None = None
    score: float | None = None


NO_STATS = FitStats(0, 0, 0.0)


class KeypointSearch(Protocol):
    """The search for inliers, by which those that were found may be doubted."""

    @property
    def ransac(self) -> RansacOptions:
        """Its options."""

    def doubt(self, residuals: FloatArray, inliers: BoolArray) -> EstimateWarning | None:
        """Warn where chance supports as many."""


@dataclass(frozen=True, eq=False)
class FittedKeypoints:
    """Keypoints of an exact or stretched model in one view, with the alignment that fits them.

    Fields without a comment are those of `cadalign.Result`.
    """

    points_3d: FloatArray  # (n, 3) on the model, of the keypoints that the view shows
    residuals: FloatArray
    inliers: BoolArray
    alignment: Alignment
    camera: Camera
    options: FitOptions
    sigma: float | None = None
    fisher_covariance: FloatArray | None = None
    symmetry: Symmetry | None = None
    method: str = "optimal"
    cost: float | None = None
    alternatives: tuple[Alternative, ...] = ()
    stats: FitStats = NO_STATS
    search: KeypointSearch | None = None  # for the inliers, where they were searched for

    @property
    def observed(self) -> FloatArray:
        """The keypoints (n, 2) [px] as they were given; NaN for those behind the camera."""
        projected = self.camera.project_where_ahead(self.alignment.apply(self.points_3d))
        with np.errstate(invalid="ignore"):  # infinite residuals
            return np.asarray(projected - self.residuals)

    @property
    def chosen_sigma(self) -> Any:
        """The keypoints' standard deviation or covariances [px]: given, or estimated."""
        return self.sigma if self.options.sigma is None else self.options.sigma


Diagnosis = Callable[[FittedKeypoints], EstimateWarning | None]
"""A function that names the cause of a misfit; see `cadalign.estimation.diagnose.diagnose_fit`."""


def quickly(kind: type[T], fields: dict[str, Any]) -> T:
    """A frozen dataclass with these fields, unchecked; those left out have their defaults.

    Setting them one by one takes longer than solving a small problem linearly.
    """
    made = object.__new__(kind)
    made.__dict__.update(fields)
    return made
