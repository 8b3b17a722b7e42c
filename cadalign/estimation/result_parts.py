"""Parts of a result: a view, the agreement of each piece of evidence, and the posterior.

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
from cadalign.estimation.options import pixel_information
from cadalign.estimation.warning import Warnings
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import by_rotation

_ROUNDING = 1e-12  # relative standard deviation below which a length is known
_FIELDS = {
    "keypoints": "points_2d",
    "photo": "image",
    "gravity": "up",
    "camera height": "camera_height",
    "rig": "cam_from_rig",
}


@dataclass(frozen=True)
class Uncertainty:
    """Predicted standard deviations of an alignment."""

    rotation_deg: float
    """Rotation [degrees]: the root of the sum of the variances about three axes."""
    translation: tuple[float, float, float]
    """Along the camera's axes [model units]."""
    scale: tuple[float, float, float]
    """Scale along the model's x, y, z, relative (0.02 is 2 %); 0 where it is known."""
    focal: float
    """Focal length, relative; 0 where it is known."""


def uncertainty_of(covariance: FloatArray) -> Uncertainty:
    """Standard deviations from a covariance (9, 9) or (10, 10)."""
    variance = np.maximum(covariance.diagonal(), 0.0)
    variance[6:9][variance[6:9] < _ROUNDING**2] = 0.0
    x, y, z, sx, sy, sz = np.sqrt(variance[3:9]).tolist()
    return Uncertainty(
        rotation_deg=float(np.degrees(np.sqrt(variance[:3].sum()))),
        translation=(x, y, z),
        scale=(sx, sy, sz),
        focal=float(np.sqrt(variance[9:].sum())),
    )


@dataclass(frozen=True)
class EvidenceSummary:
    """Agreement of one piece of evidence with a joint estimate."""

    kind: str
    """Name of the kind: "keypoints", "mask", "photo", "depth", "gravity", "size", "camera height",
    "rig"."""
    view: int | None
    """Number of the view; None for the object's size."""
    count: int
    """Number of measurements: keypoints, contour pixels, depths, directions, lengths."""
    rms_sigmas: float
    """Root mean square residual, in standard deviations of the measurements."""
    rms: float
    """Root mean square residual in ``unit``."""
    unit: str
    """One of "px", "deg", "" (the unit of lengths). A camera's motion has no residual."""
    share: float | None = None
    """Share of the model's outline that was found in a photo, 0 where the photo was left out."""

    @property
    def name(self) -> str:
        """The argument that gave it.

        Examples
        --------
        >>> EvidenceSummary("gravity", 1, 1, 0.5, 0.5, "deg").name
        'views[1].up'
        """
        return name_of(self.kind, self.view)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name}: rms {self.rms:.3g}{unit}, {self.rms_sigmas:.2g} sigma"


def name_of(kind: str, view: int | None) -> str:
    """The argument that gives a piece of evidence.

    Examples
    --------
    >>> name_of("size", None), name_of("depth", 0)
    ('size', 'views[0].depth')
    """
    return kind if view is None else f"views[{view}].{_FIELDS.get(kind, kind)}"


def listed(clauses: Sequence[str]) -> str:
    """Names or clauses of which one is meant."""
    *some, last = clauses
    return f"{', '.join(some)} or {last}" if some else last


def keypoint_evidence(fitted: FittedKeypoints) -> tuple[EvidenceSummary, ...]:
    """Agreement of the keypoints that the estimate rests on."""
    residuals = fitted.residuals[fitted.inliers]
    count = max(len(residuals), 1)
    rms = float(np.sqrt((residuals * residuals).sum() / count))
    sigma = fitted.chosen_sigma
    if np.ndim(sigma) == 0:
        unit = 1.0 if sigma is None else float(sigma)
        with np.errstate(over="ignore"):  # of the least positive number
            in_sigmas = float(np.nan_to_num(np.divide(rms / np.sqrt(2.0), unit)))
    else:
        information = pixel_information(sigma, len(fitted.residuals))[fitted.inliers]
        whitened = np.einsum("ni,nij,nj->", residuals, information, residuals)
        in_sigmas = float(np.sqrt(whitened / (2 * count)))
    return (EvidenceSummary("keypoints", 0, len(residuals), in_sigmas, rms, "px"),)


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
        from cadalign.estimation.uncertainty.posterior import keypoint_covariance

        return keypoint_covariance(self.keypoints)

    @cached_property
    def warnings(self) -> Warnings:
        """See `cadalign.Result.warnings`."""
        if self.keypoints is None:
            return ()
        from cadalign.estimation.uncertainty.doubts import keypoint_warnings

        return keypoint_warnings(self.keypoints, self.covariance, self.diagnosis)

    @cached_property
    def evidence(self) -> tuple[EvidenceSummary, ...]:
        """See `cadalign.Result.evidence`."""
        return () if self.keypoints is None else keypoint_evidence(self.keypoints)


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
