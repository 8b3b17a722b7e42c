"""Agreement of a mask's contour with an estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import BoolArray, FloatArray


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
