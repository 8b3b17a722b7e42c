"""Scan2CAD's alignment accuracy: 20 cm, 20 degrees and 20 % of scale.

Avetisyan et al., "Scan2CAD: Learning CAD Model Alignment in RGB-D Scans", CVPR 2019, section 8, and
the benchmark's script.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics.photos import MetricSet, model_rotation_error
from cadalign.evaluation.runs.work import Row
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.metrics import scale_error
from cadalign.geometry.symmetry import Symmetry

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTarget

MAX_TRANSLATION = 0.2
"""[m]"""
MAX_ROTATION_DEG = 20.0
MAX_SCALE = 0.2
"""Fraction."""


@dataclass(frozen=True)
class Scan2CadErrors:
    """Errors of one alignment."""

    translation: float  # distance of the positions [m]
    rotation_deg: float  # angle to the nearest rotation that looks the same [degrees]
    scale: float
    """The benchmark's: the mean over the axes of the ratio to the truth, less 1; a fraction. Errors
    of opposite sign cancel in it."""
    scale_axes: FloatArray  # (3,), relative error along each axis

    @property
    def is_aligned(self) -> bool:
        """True if no error is over its threshold."""
        return (
            self.translation <= MAX_TRANSLATION
            and self.rotation_deg <= MAX_ROTATION_DEG
            and self.scale <= MAX_SCALE
        )

    @property
    def is_aligned_on_each_axis(self) -> bool:
        """True if neither is the scale along any axis."""
        return self.is_aligned and bool((self.scale_axes <= MAX_SCALE).all())


def scan2cad_errors(
    *,
    est: Alignment,
    gt: Alignment,
    symmetry: Symmetry | None = None,
    center: FloatArray | None = None,
) -> Scan2CadErrors:
    """Errors of an estimate of a true alignment, in metres.

    Positions of the point ``center`` (3,) of the model are compared, by default of its origin.
    Rotations about an axis of symmetry are compared exactly; the benchmark's script takes steps of
    10 degrees there, so that its errors are larger by up to 5 degrees.
    """
    symmetry = symmetry or Symmetry.none()
    point = np.zeros(3) if center is None else center
    gap = est.apply([point])[0] - gt.apply([point])[0]
    return Scan2CadErrors(
        translation=float(np.linalg.norm(gap)),
        rotation_deg=model_rotation_error(est=est, gt=gt, symmetry=symmetry),
        scale=float(np.abs(np.mean(est.scale / gt.scale) - 1)),
        scale_axes=scale_error(est=est, gt=gt),
    )


TRANSLATION = Metric("scan2cad_translation_m", "translation error", "m", 3, symbol="t m")
SCALE = Metric("scan2cad_scale", "mean scale error", "%", 1, factor=100.0, symbol="s %")
ALIGNED = metrics.rate("scan2cad_aligned", "Scan2CAD accuracy", "acc %")
ALIGNED_AXES = metrics.rate("scan2cad_aligned_axes", "Scan2CAD accuracy, each axis", "acc xyz %")


def _measure(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    # The benchmark's script takes minus the centre of the model's box.
    center = None if target.bounds is None else -target.bounds.mean(axis=0)
    errors = scan2cad_errors(est=est, gt=gt, symmetry=target.found.symmetry, center=center)
    return {
        TRANSLATION.key: errors.translation,
        SCALE.key: errors.scale,
        ALIGNED.key: float(errors.is_aligned),
        ALIGNED_AXES.key: float(errors.is_aligned_on_each_axis),
    }


SCAN2CAD = MetricSet(
    _measure,
    columns=(TRANSLATION.key, SCALE.key, ALIGNED.key, ALIGNED_AXES.key),
    medians=(TRANSLATION, SCALE),
    shares=(ALIGNED, ALIGNED_AXES),
    headline=(ALIGNED, ALIGNED_AXES),
    details=(TRANSLATION, SCALE),
    console=(ALIGNED,),
)
