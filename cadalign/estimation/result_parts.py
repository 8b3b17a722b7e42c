"""Parts of a result: what is said of a view, an alternative, the effort, and the uncertainty.

Statements about the uncertainty are stored, or computed when they are asked for. Covariances are
those of the rotation vector in the camera frame [rad], the translation, the logarithms of the
lengths along x, y, z, and, where it was estimated, of the focal length.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.focal import focal_doubt
from cadalign.estimation.options import pixel_information
from cadalign.estimation.uncertainty.posterior import FittedKeypoints, posterior_covariance
from cadalign.estimation.uncertainty.summary import (
    EvidenceSummary,
    Misfit,
    Uncertainty,
    another_pose,
    uncertainty_of,
    weaknesses_of_keypoints,
)
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.alignment import Alignment, Box, extent
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import by_rotation

if TYPE_CHECKING:
    from cadalign.estimation.consensus import RobustSearch

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
class Stated:
    """Statements that are known."""

    covariance: FloatArray | None
    fisher_covariance: FloatArray | None = None
    points_covariance: FloatArray | None = None
    points_cam_covariance: FloatArray | None = None
    warnings: Warnings = ()
    misfit: Misfit | None = None
    evidence: tuple[EvidenceSummary, ...] = ()
    degrees_of_freedom: float | None = None

    @classmethod
    def of(cls, statistics: Statistics, **changes: Any) -> Stated:
        """All statements, computed now, but for those that are changed."""
        known = {name: getattr(statistics, name) for name in cls.__dataclass_fields__}
        return cls(**known | changes)


@dataclass(frozen=True, eq=False)
class KeypointStatistics(FittedKeypoints):
    """Statements about an exact or stretched model's keypoints in one view.

    ``search`` is how inliers were searched for, where they were.
    """

    search: RobustSearch | None = None
    alternatives: tuple[Alternative, ...] = ()
    points_covariance = points_cam_covariance = degrees_of_freedom = None

    @cached_property
    def covariance(self) -> FloatArray | None:
        """See `cadalign.Result.covariance`."""
        if self.fisher_covariance is None:
            return None
        covariance = posterior_covariance(self)
        if self.symmetry is None:
            return covariance
        from cadalign.estimation.symmetry import held_axes, without_free_turns
        from cadalign.geometry.symmetry_group import group_of  # most models have none

        held = held_axes(self.options.stretched_axes)
        best = group_of(self.symmetry).canonical(self.alignment, held=held)
        return without_free_turns(covariance, best)

    @cached_property
    def misfit(self) -> Misfit | None:
        """See `cadalign.Result.misfit`."""
        if self.fisher_covariance is None:
            return None
        from cadalign.estimation.uncertainty.misfit import find_misfit

        return find_misfit(self)

    @cached_property
    def warnings(self) -> Warnings:
        """Warnings about mistakes, a misfit, and what the keypoints do not determine."""
        mistake = self._mistake()
        if mistake is not None:  # nothing else can be said of the alignment
            return (mistake,)
        observed = self._observed()
        placed = self._placed(observed)
        if self.covariance is None:
            return placed
        from cadalign.estimation.uncertainty.misfit import unexplained, unverified_stretch

        if self.misfit is not None:
            doubts = [self.misfit.warning]
        else:
            unverified = unverified_stretch(self)
            doubts = [] if unverified is None else [unverified]
        if self.sigma is not None and self.options.sigma is None:
            doubts.extend(unexplained(self.sigma, [observed]))
        chance = self.search and self.search.doubt(self.residuals, self.inliers)
        if chance:
            doubts.append(chance)
        kept, options = self.points_3d[self.inliers], self.options
        is_estimated = options.focal == "estimate"
        weak = weaknesses_of_keypoints(
            kept,
            self.alignment,
            self.covariance,
            redundancy=2 * len(kept) - options.unknowns,
            stretch_sigma=options.stretch_sigma,
            doubt=focal_doubt(self.camera, options.focal_prior) if is_estimated else None,
        )
        others: Warnings = ()
        # Likelihoods tell nothing where keypoints do not fit, or others than these were rejected.
        if self.misfit is None and self.search is None:
            poses = [(each.alignment, each.relative_likelihood) for each in self.alternatives]
            others = another_pose(self.alignment, poses, self.covariance)
        return (*placed, *doubts, *weak, *others)

    def _observed(self) -> FloatArray:
        """The keypoints in the image (n, 2) [px] that have residuals."""
        ahead = np.isfinite(self.residuals).all(axis=1)
        in_camera = self.alignment.apply(self.points_3d[ahead])
        return self.camera.project_where_ahead(in_camera) - self.residuals[ahead]

    def _placed(self, observed: FloatArray) -> Warnings:
        """Warnings about keypoints (n, 2) [px] and a principal point outside of the image."""
        if self.camera.is_centred and self.camera.contains(observed).all():
            return ()
        from cadalign.estimation.mistakes import outside_image  # rarely asked

        return outside_image(observed, self.camera, agree=self.misfit is None)

    def _mistake(self) -> EstimateWarning | None:
        if self.search is None:
            if self.fisher_covariance is None:
                return None
            if self.misfit is None and self.options.sigma is not None:
                return None
            from cadalign.estimation.uncertainty.misfit import mistake_in_fit

            return mistake_in_fit(self, self.misfit)
        from cadalign.estimation.consensus import mistake_in  # with the kernels of the search

        return mistake_in(self.search, self.search.explained(self.alignment, self.residuals))

    @cached_property
    def evidence(self) -> tuple[EvidenceSummary, ...]:
        """Agreement of the keypoints that the estimate rests on."""
        residuals = self.residuals[self.inliers]
        count = max(len(residuals), 1)
        rms = float(np.sqrt((residuals * residuals).sum() / count))
        sigma = self.chosen_sigma
        if np.ndim(sigma) == 0:
            unit = 1.0 if sigma is None else float(sigma)
            with np.errstate(over="ignore"):  # of the least positive number
                in_sigmas = float(np.nan_to_num(np.divide(rms / np.sqrt(2.0), unit)))
        else:
            information = pixel_information(sigma, len(self.residuals))[self.inliers]
            whitened = np.einsum("ni,nij,nj->", residuals, information, residuals)
            in_sigmas = float(np.sqrt(whitened / (2 * count)))
        return (EvidenceSummary("keypoints", 0, len(residuals), in_sigmas, rms, "px"),)


Statistics = Stated | KeypointStatistics
"""What is stated, by whatever door a result came."""


def points_covariances(
    points: FloatArray, alignment: Alignment, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (m, 3, 3) of stretched points in the model's frame and in the camera's."""
    covariance = covariance[:9, :9]
    stretched = points * alignment.scale
    by_logs = stretched[:, :, None] * np.eye(3)
    of_points = by_logs @ covariance[6:, 6:] @ by_logs.swapaxes(1, 2)
    turned = stretched @ alignment.rotation.T
    shifts = np.broadcast_to(np.eye(3), by_logs.shape)
    rows = np.concatenate([by_rotation(turned), shifts, alignment.rotation @ by_logs], axis=2)
    return of_points, rows @ covariance @ rows.swapaxes(1, 2)


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
