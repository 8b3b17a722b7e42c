"""Errors between an estimate and the truth: the public names of `cadalign.geometry.metrics`."""

from cadalign.geometry.metrics import (
    alignment_box_iou,
    box_iou,
    box_iou_up_to_scale,
    nearest_truth,
    reprojection_error,
    rotation_error,
    scale_error,
    translation_error,
    translation_error_up_to_scale,
)

__all__ = [
    "alignment_box_iou",
    "box_iou",
    "box_iou_up_to_scale",
    "nearest_truth",
    "reprojection_error",
    "rotation_error",
    "scale_error",
    "translation_error",
    "translation_error_up_to_scale",
]
