"""Cameras, alignments, boxes and meshes, their conventions and their metrics."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.geometry.alignment import Alignment, Box
    from cadalign.geometry.camera import Camera
    from cadalign.geometry.conventions import (
        opengl_from_model,
        opengl_projection,
        up_from_gravity,
        up_from_pose,
    )
    from cadalign.geometry.mesh import Material, Mesh
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
    from cadalign.geometry.symmetry import Symmetry, SymmetryAxis

__all__ = [
    "Alignment",
    "Box",
    "Camera",
    "Material",
    "Mesh",
    "Symmetry",
    "SymmetryAxis",
    "alignment_box_iou",
    "box_iou",
    "box_iou_up_to_scale",
    "nearest_truth",
    "opengl_from_model",
    "opengl_projection",
    "reprojection_error",
    "rotation_error",
    "scale_error",
    "translation_error",
    "translation_error_up_to_scale",
    "up_from_gravity",
    "up_from_pose",
]

__getattr__ = lazy_names(__name__)
