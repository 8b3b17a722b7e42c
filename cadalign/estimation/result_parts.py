"""Parts of a result: what is said of a view, of an alternative, and of the effort."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.uncertainty.stated import Statistics
from cadalign.estimation.uncertainty.summary import Uncertainty, uncertainty_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera

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


@dataclass(frozen=True, eq=False)
class ViewResult:
    """Estimate of one view.

    Parameters
    ----------
    camera : Camera
        Its camera; with the estimated focal length, where that was unknown.
    alignment : Alignment
        Pose in that camera, and scale.
    ids : sequence of int or str
        Ids of its keypoints.
    points_2d : (n, 2) float
        Observed keypoints [px].
    residuals : (n, 2) float
        Projected minus observed keypoints [px]; infinite, and null in JSON, for one that was
        rejected and lies behind the camera.
    inliers : (n,) bool
        The keypoints that the estimate rests on.
    statistics : Statistics
        States the ``covariance``.
    """

    camera: Camera
    alignment: Alignment
    ids: Sequence[Hashable]
    points_2d: FloatArray
    residuals: FloatArray
    inliers: BoolArray
    statistics: Statistics = field(repr=False)

    @property
    def covariance(self) -> FloatArray | None:
        """Covariance in this camera's frame; see `cadalign.Result.covariance`."""
        return self.statistics.covariance

    @property
    def std(self) -> Uncertainty | None:
        """Standard deviations from ``covariance``; None for methods that have none."""
        return None if self.covariance is None else uncertainty_of(self.covariance)

    @property
    def rms(self) -> float:
        """Root mean square length of the inliers' residuals [px]."""
        return rms_of(self.residuals, self.inliers)


def quickly(kind: type[T], fields: dict[str, Any]) -> T:
    """A frozen dataclass with these fields, unchecked; those left out have their defaults.

    Setting them one by one takes longer than solving a small problem linearly.
    """
    made = object.__new__(kind)
    made.__dict__.update(fields)
    return made


def rms_of(residuals: FloatArray, inliers: BoolArray) -> float:
    """Root mean square length of residuals (n, 2), of the inliers (n,) alone."""
    kept = residuals[inliers]
    return float(np.sqrt((kept * kept).sum() / max(len(kept), 1)))


def extent(points: FloatArray) -> FloatArray:
    """Least and greatest coordinates (2, 3) of points."""
    return np.array([points.min(axis=0), points.max(axis=0)])
