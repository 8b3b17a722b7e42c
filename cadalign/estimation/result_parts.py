"""Parts of a result: a view, and the posterior.

Covariances are those of the rotation vector in the camera frame [rad], the translation, the
logarithms of the lengths along x, y, z, and, where it was estimated, of the focal length.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.fitted import Diagnosis, FittedKeypoints, quickly
from cadalign.estimation.uncertainty.summary import (
    EvidenceSummary,
    Uncertainty,
    uncertainty_of,
)
from cadalign.estimation.warning import Warnings
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import by_rotation


@dataclass(frozen=True, eq=False)
class Posterior:
    """Uncertainty of an estimate, and warnings about it; see `cadalign.Result`.

    That of ``keypoints`` alone is computed when it is asked for; that of other evidence is made by
    `stated`. Without anything it says nothing.
    """

    keypoints: FittedKeypoints | None = None
    diagnosis: Diagnosis | None = None
    fisher_covariance: FloatArray | None = None
    points_covariance: FloatArray | None = None
    points_cam_covariance: FloatArray | None = None
    degrees_of_freedom: float | None = None

    @classmethod
    def stated(cls, covariance: FloatArray | None, **known: Any) -> Posterior:
        """With a covariance, and any of the fields and properties."""
        return cls().stating(covariance=covariance, **known)

    def stating(self, **known: Any) -> Posterior:
        """A copy with other values of any of the fields and properties."""
        return quickly(Posterior, vars(self) | known)

    @cached_property
    def covariance(self) -> FloatArray | None:
        """See `cadalign.Result.covariance`."""
        if self.keypoints is None:
            return None
        from cadalign.estimation.uncertainty.keypoints import keypoint_covariance

        return keypoint_covariance(self.keypoints)

    @cached_property
    def warnings(self) -> Warnings:
        """See `cadalign.Result.warnings`."""
        if self.keypoints is None:
            return ()
        from cadalign.estimation.uncertainty.keypoints import keypoint_warnings

        return keypoint_warnings(self.keypoints, self.covariance, self.diagnosis)

    @cached_property
    def evidence(self) -> tuple[EvidenceSummary, ...]:
        """See `cadalign.Result.evidence`."""
        if self.keypoints is None:
            return ()
        from cadalign.estimation.uncertainty.keypoints import keypoint_evidence

        return keypoint_evidence(self.keypoints)


class OutlineNotes(NamedTuple):
    """Additions of masks and photos to a result."""

    evidence: tuple[EvidenceSummary, ...] = ()
    warnings: Warnings = ()


NO_NOTES = OutlineNotes()


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
    posterior : Posterior
        Has the ``covariance``.
    """

    camera: Camera
    alignment: Alignment
    ids: Sequence[Hashable]
    points_2d: FloatArray
    residuals: FloatArray
    inliers: BoolArray
    posterior: Posterior = field(repr=False)

    @property
    def covariance(self) -> FloatArray | None:
        """Covariance in this camera's frame; see `cadalign.Result.covariance`."""
        return self.posterior.covariance

    @property
    def std(self) -> Uncertainty | None:
        """Standard deviations from ``covariance``; None for methods that have none."""
        return None if self.covariance is None else uncertainty_of(self.covariance)

    @property
    def rms(self) -> float:
        """Root mean square length of the inliers' residuals [px]."""
        return rms_of(self.residuals, self.inliers)


def rms_of(residuals: FloatArray, inliers: BoolArray) -> float:
    """Root mean square length of residuals (n, 2), of the inliers (n,) alone."""
    kept = residuals[inliers]
    return float(np.sqrt((kept * kept).sum() / max(len(kept), 1)))
