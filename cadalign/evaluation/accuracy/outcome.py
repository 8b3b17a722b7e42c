"""What became of one instance under one method: its errors, or why it failed."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.evaluation.instances.symmetry import SymmetryGroup
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import box_iou, rotation_error, scale_error, translation_error

OK = "ok"
FAILED = "failed"


@dataclass(frozen=True)
class Outcome:
    """One row of a result table.

    Parameters
    ----------
    category, model_id : str
    view : int
        Which view of the model.
    method : str
    status : str
        ``ok`` or ``failed``.
    reason : str
        Why it failed; empty otherwise.
    visibility : str
        How it was found out which keypoints are seen: ``rays`` or ``hull``; empty if it failed
        before.
    keypoints : int
        How many keypoints the method was given.
    stretch_y, stretch_z : float
        What the model was stretched by; the true scales are one over these.
    rotation_error_deg : float
        [degrees]
    translation_error : float
        [model units]
    scale_y_error, scale_z_error : float
        Relative errors, fractions.
    box_iou : float
        Of the stretched model's true and predicted box; None for a model without volume.
    rms_px : float
        Of the residuals [px].
    symmetry : str
        The model's: ``none``, ``circle``, or how many rotations map it onto itself.
    sym_rotation_error_deg, sym_translation_error, sym_box_iou : float
        The same errors from the nearest truth that looks the same; see
        `cadalign.evaluation.instances.symmetry`. Errors of the scale do not depend on it.
    seconds : float
        How long it took. Not part of a result table, since no two runs agree on it.

    The numbers of a failed instance are None.
    """

    category: str
    model_id: str
    view: int
    method: str
    status: str
    reason: str
    visibility: str
    keypoints: int | None
    stretch_y: float | None
    stretch_z: float | None
    rotation_error_deg: float | None
    translation_error: float | None
    scale_y_error: float | None
    scale_z_error: float | None
    box_iou: float | None
    rms_px: float | None
    symmetry: str
    sym_rotation_error_deg: float | None
    sym_translation_error: float | None
    sym_box_iou: float | None
    seconds: float

    @classmethod
    def of_alignment(
        cls,
        est: Alignment,
        *,
        gt: Alignment,
        gt_box: Box,
        bounds: FloatArray,
        symmetry: SymmetryGroup,
        rms_px: float,
        **labels: Any,
    ) -> Outcome:
        """The errors of an estimate; ``labels`` are the fields that name and time the row."""
        _, scale_y, scale_z = scale_error(est=est, gt=gt).tolist()
        box = Box.from_model(bounds, est)
        errors = _pose_errors(est, box, gt, gt_box)
        truth = symmetry.nearest_truth(est=est, gt=gt)
        sym_errors = errors
        if truth is not gt:
            sym_errors = _pose_errors(est, box, truth, Box.from_model(bounds, truth))
        return cls(
            status=OK,
            reason="",
            rotation_error_deg=errors[0],
            translation_error=errors[1],
            scale_y_error=scale_y,
            scale_z_error=scale_z,
            box_iou=errors[2],
            rms_px=rms_px,
            symmetry=str(symmetry),
            sym_rotation_error_deg=sym_errors[0],
            sym_translation_error=sym_errors[1],
            sym_box_iou=sym_errors[2],
            **labels,
        )

    @classmethod
    def of_failure(cls, reason: str, **labels: Any) -> Outcome:
        """A failed instance; ``labels`` are the fields that are known of it."""
        blank = {field.name: _BLANK.get(field.name) for field in fields(cls)}
        return cls(**{**blank, "status": FAILED, "reason": reason, **labels})

    @classmethod
    def columns(cls) -> list[str]:
        """The names of a result table's columns, in order: all but the time."""
        return [field.name for field in fields(cls) if field.name != "seconds"]

    def row(self) -> dict[str, Any]:
        """The fields as a table row; None is an empty cell."""
        return {name: getattr(self, name) for name in self.columns()}

    def timing(self) -> dict[str, Any]:
        """What names the row, and its time."""
        return {name: getattr(self, name) for name in (*_KEY, "seconds")}


_KEY = ("category", "model_id", "view", "method")
_BLANK: dict[str, Any] = {"visibility": "", "symmetry": "", "seconds": 0.0, "view": 0}


def _pose_errors(
    est: Alignment, est_box: Box, gt: Alignment, gt_box: Box
) -> tuple[float, float, float | None]:
    """Rotation, translation, box IoU."""
    try:
        iou = box_iou(est=est_box, gt=gt_box)
    except InputError:  # a box without volume has none
        iou = None
    return rotation_error(est=est, gt=gt), translation_error(est=est, gt=gt), iou
