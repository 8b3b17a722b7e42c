"""What a method made of one image with wrong correspondences: its errors, or why it failed."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from cadalign.evaluation.accuracy.methods import is_robust
from cadalign.evaluation.accuracy.outcome import OK
from cadalign.evaluation.runs.work import Columns
from cadalign.evaluation.simulation.problems import Problem
from cadalign.fitting.result import FitResult
from cadalign.geometry.metrics import rotation_error, scale_error, translation_error

SUCCESS_DEG = 0.5
"""A success has less than this rotation error [degrees] ..."""
SUCCESS_SCALE = 0.01
"""... and at most this relative error of either scale."""


@dataclass(frozen=True)
class CorrespondenceOutcome:
    """One row of a result table.

    Parameters
    ----------
    image : str
    draw : int
    outliers : float
        Share of the image points that were moved.
    method : str
    status : str
        ``ok`` or ``failed``.
    reason : str
        Why it failed; empty otherwise.
    points : int
        How many the method was given; None where the image could not be read.
    inliers : int
        How many it kept; None for methods that do not search for inliers.
    rotation_error_deg : float
        [degrees]
    translation_error : float
        Over the distance from the camera to the mean of the image's points, a fraction.
    scale_y_error, scale_z_error : float
        Relative errors, fractions.
    success : bool
        Whether the rotation error is less than 0.5 degrees and neither scale is off by more than
        1 %.
    inlier_precision : float
        Which share of the points that it kept were not moved.
    inlier_recall : float
        Which share of the points that were not moved it kept.
    """

    image: str
    draw: int
    outliers: float
    method: str
    status: str
    reason: str = ""
    points: int | None = None
    inliers: int | None = None
    rotation_error_deg: float | None = None
    translation_error: float | None = None
    scale_y_error: float | None = None
    scale_z_error: float | None = None
    success: bool = False
    inlier_precision: float | None = None
    inlier_recall: float | None = None

    @classmethod
    def columns(cls) -> Columns:
        """The names and types of a result table's columns."""
        kinds = {"int": int, "float": float, "str": str, "bool": bool}
        return tuple(
            (field.name, kinds[str(field.type).removesuffix(" | None")]) for field in fields(cls)
        )

    @classmethod
    def of_fit(cls, result: FitResult, truth: Problem, **labels: Any) -> CorrespondenceOutcome:
        """What a method made of a problem."""
        est, gt = result.alignment, truth.alignment
        distance = np.linalg.norm(gt.apply(truth.points_3d).mean(axis=0))
        rotation = rotation_error(est=est, gt=gt)
        _, scale_y, scale_z = scale_error(est=est, gt=gt).tolist()
        outcome = cls(
            **labels,
            status=OK,
            points=len(truth.points_3d),
            rotation_error_deg=rotation,
            translation_error=translation_error(est=est, gt=gt) / float(distance),
            scale_y_error=scale_y,
            scale_z_error=scale_z,
            success=rotation < SUCCESS_DEG and max(scale_y, scale_z) <= SUCCESS_SCALE,
        )
        if not is_robust(outcome.method):
            return outcome
        kept = int(result.inliers.sum())
        right = np.ones(len(truth.points_3d), bool) if truth.outliers is None else ~truth.outliers
        kept_right = int((result.inliers & right).sum())
        return replace(
            outcome,
            inliers=kept,
            inlier_precision=kept_right / max(kept, 1),
            inlier_recall=kept_right / max(int(right.sum()), 1),
        )
