"""What a result tells about each piece of evidence: summary, contribution, residuals of masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.uncertainty.weakness import Uncertainty

KINDS = ("keypoints", "mask", "depth", "gravity", "size", "camera height", "rig")
"""Kinds of evidence."""
_FIELDS = {
    "keypoints": "points_2d",
    "mask": "mask",
    "depth": "depth",
    "gravity": "up",
    "camera height": "camera_height",
    "rig": "cam_from_rig",
}


@dataclass(frozen=True)
class EvidenceSummary:
    """Agreement of one piece of evidence with a joint estimate.

    Parameters
    ----------
    kind : str
        "keypoints", "mask", "depth", "gravity", "size", "camera height" or "rig".
    view : int, optional
        Number of the view; None for the object's size.
    count : int
        Number of measurements: keypoints, contour pixels, depths, directions, lengths.
    rms_sigmas : float
        Root mean square residual, in standard deviations of the measurements.
    rms : float
        Root mean square residual in ``unit``.
    unit : str
        "px", "deg" or "" (the unit of lengths). A camera's motion has no residual of its own.
    """

    kind: str
    view: int | None
    count: int
    rms_sigmas: float
    rms: float
    unit: str

    @property
    def name(self) -> str:
        """The argument that gave it.

        Examples
        --------
        >>> EvidenceSummary("gravity", 1, 1, 0.5, 0.5, "deg").name
        'views[1].up'
        """
        return name_of(self.kind, self.view)


@dataclass(frozen=True)
class Contribution:
    """Deviations of a joint estimate with all evidence but one piece.

    Parameters
    ----------
    kind, view
        As of `EvidenceSummary`.
    without : Uncertainty
        Standard deviations without the piece, infinite for what nothing else determines.
    """

    kind: str
    view: int | None
    without: Uncertainty

    @property
    def name(self) -> str:
        """The argument that gave the piece."""
        return name_of(self.kind, self.view)


def name_of(kind: str, view: int | None) -> str:
    """The argument that gives a piece of evidence.

    Examples
    --------
    >>> name_of("size", None), name_of("depth", 0)
    ('size', 'views[0].depth')
    """
    return kind if view is None else f"views[{view}].{_FIELDS[kind]}"


@dataclass(frozen=True, eq=False)
class MaskResiduals:
    """The model's rim beside a mask's contour, at samples 2 px apart along it.

    Parameters
    ----------
    points : (s, 2) float
        Samples of the contour, without those near the image's border [px]; of the mask's convex
        hull where the model is similar to the object in its outermost points alone.
    normals : (s, 2) float
        Unit normals, from the object outwards.
    residuals : (s,) float
        How far outside of the contour the model's rim lies along the normal, ``offset`` added [px];
        NaN where no rim is near.
    inliers : (s,) bool
        Samples that agree with the rest.
    sigma : float
        Standard deviation of the residuals, given or estimated [px].
    correlation : float
        Number of neighbouring samples that count as one, for their residuals are alike.
    offset : float
        How far outside of the model's rim the whole contour lies, as that of a dilated mask does
        [px].
    is_used : bool
        False for a mask that contradicts the rest of the evidence, which was left out.
    """

    points: FloatArray
    normals: FloatArray
    residuals: FloatArray
    inliers: BoolArray
    sigma: float
    correlation: float
    offset: float
    is_used: bool = True

    @property
    def rms(self) -> float:
        """Root mean square residual of the inliers [px]."""
        kept = self.residuals[self.inliers]
        return float(np.sqrt((kept**2).mean())) if len(kept) else float("nan")

    @property
    def support(self) -> float:
        """Share of the samples that are inliers."""
        return float(self.inliers.mean())
