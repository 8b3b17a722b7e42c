"""Statements of a result about its evidence: summary, contribution, misfit, residuals of masks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.evidence_kinds import field_of
from cadalign.estimation.uncertainty.weakness import Uncertainty

_MOST_NAMED = 5  # outliers, in a sentence


@dataclass(frozen=True)
class EvidenceSummary:
    """Agreement of one piece of evidence with a joint estimate.

    Parameters
    ----------
    kind : str
        "keypoints", "mask", "depth", "gravity", "size", "camera height", "rig", or the name of a
        registered kind.
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
    return kind if view is None else f"views[{view}].{field_of(kind)}"


@dataclass(frozen=True)
class Misfit:
    """Residuals that are larger than the standard deviations of the keypoints explain.

    Parameters
    ----------
    chi_square : float
        Sum of the losses on the whitened residuals: of their squares, with the linear loss.
    redundancy : int
        What is expected of it: the equations minus the unknowns.
    free_scale : tuple of 3 float, optional
        The scales without the constraints on them (stretch=, scale_prior_sigma), where it is these
        that contradict the keypoints.
    outliers : mapping of int to float
        The keypoints without which the others fit, and their distances from where the others put
        them [px]; empty where no few keypoints are to blame.
    """

    chi_square: float
    redundancy: int
    free_scale: tuple[float, float, float] | None = None
    outliers: Mapping[int, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, for JSON."""
        outliers = [{"row": row, "distance_px": px} for row, px in self.outliers.items()]
        return {
            "chi_square": self.chi_square,
            "redundancy": self.redundancy,
            "free_scale": None if self.free_scale is None else list(self.free_scale),
            "outliers": outliers,
        }

    def __str__(self) -> str:
        if self.free_scale is not None:
            scale = ", ".join(f"{value:.3g}" for value in self.free_scale)
            return (
                f"the keypoints contradict the constraint on the stretch: without it they fit "
                f"better, with the scale ({scale})"
            )
        ratio = math.sqrt(self.chi_square / self.redundancy)
        text = f"the residuals are {ratio:.2g} times as large as sigma explains: "
        if not self.outliers:
            return text + (
                "the keypoints do not fit the model together (wrong pairs, model, stretch or "
                "camera), or sigma is too small; sigma=None suits a model that is only similar"
            )
        worst = sorted(self.outliers, key=lambda row: -self.outliers[row])[:_MOST_NAMED]
        named = ", ".join(f"{row} ({self.outliers[row]:.3g} px)" for row in worst)
        if len(worst) < len(self.outliers):
            named += f" and {len(self.outliers) - len(worst)} more"
        one = len(self.outliers) == 1
        return text + (
            f"keypoint{'' if one else 's'} {named} {'does' if one else 'do'} not fit the others "
            "(counted from 0, with the distance from where those put it)"
        )


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
