"""Errors of alignments and boxes, single or stacked: the formulas of `cadalign.geometry.metrics`.

A stack's arrays have leading dimensions (...) more than those of one: `Alignments`, `Boxes` and
`cadalign.Results` are stacks, `Alignment` and `Box` single. Errors of a stack are those of its
members, bit for bit. Nothing is checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import oriented_box
from cadalign.geometry.rotations import angles_between, dots, lengths

_LEAST_SIDE = 1e-9  # of the longest side of a box with a volume


class PoseArrays(Protocol):
    """Rotations (..., 3, 3), translations (..., 3) and scales (..., 3)."""

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrices."""

    @property
    def translation(self) -> FloatArray:
        """The model's origin in the camera frame."""

    @property
    def scale(self) -> FloatArray:
        """Stretch along the model's axes."""


class BoxArrays(Protocol):
    """Centres (..., 3), axes (..., 3, 3) as columns, and side lengths (..., 3)."""

    @property
    def center(self) -> FloatArray:
        """The centres."""

    @property
    def rotation(self) -> FloatArray:
        """The axes."""

    @property
    def extents(self) -> FloatArray:
        """The side lengths."""


class Alignments(NamedTuple):
    """Alignments of n models: their rotations (n, 3, 3), translations (n, 3) and scales (n, 3)."""

    rotation: FloatArray
    translation: FloatArray
    scale: FloatArray

    @classmethod
    def of(cls, alignments: Sequence[Alignment]) -> Alignments:
        """Stack single alignments, at least one."""
        return cls(
            np.array([each.rotation for each in alignments]),
            np.array([each.translation for each in alignments]),
            np.array([each.scale for each in alignments]),
        )


class Boxes(NamedTuple):
    """Boxes of n models: their centres (n, 3), axes (n, 3, 3) and side lengths (n, 3)."""

    center: FloatArray
    rotation: FloatArray
    extents: FloatArray

    @classmethod
    def from_models(cls, bounds: FloatArray, alignments: Alignments) -> Boxes:
        """The boxes of models with the bounds (n, 2, 3); see `Box.from_model`."""
        return cls(*oriented_box(bounds, *alignments))


def rotation_errors(*, est: PoseArrays, gt: PoseArrays) -> FloatArray:
    """Angles (...) [degrees]; see `cadalign.geometry.metrics.rotation_error`."""
    return angles_between(est.rotation, gt.rotation)


def translation_errors(*, est: PoseArrays, gt: PoseArrays) -> FloatArray:
    """Distances (...) [model units]; see `cadalign.geometry.metrics.translation_error`."""
    return lengths(est.translation - gt.translation)


def translation_errors_up_to_scale(*, est: PoseArrays, gt: PoseArrays) -> FloatArray:
    """Distances (...); see `cadalign.geometry.metrics.translation_error_up_to_scale`."""
    squares = dots(est.translation, est.translation)
    products = dots(est.translation, gt.translation)
    factors = np.divide(products, squares, out=np.zeros_like(squares), where=squares > 0)
    return lengths(np.maximum(factors, 0.0)[..., None] * est.translation - gt.translation)


def scale_errors(*, est: PoseArrays, gt: PoseArrays) -> FloatArray:
    """Relative errors (..., 3) along each axis; see `cadalign.geometry.metrics.scale_error`."""
    return np.asarray(np.abs(est.scale - gt.scale) / gt.scale)


def have_volume(boxes: BoxArrays) -> BoolArray:
    """Mask (...) of the boxes that are not flat."""
    extents = boxes.extents
    return np.asarray(extents.min(axis=-1) > _LEAST_SIDE * extents.max(axis=-1))


def box_ious(*, est: BoxArrays, gt: BoxArrays) -> FloatArray:
    """Intersections over unions (...) of boxes that have a volume.

    See `cadalign.geometry.metrics.box_iou`.
    """
    from cadalign.geometry.clipping import intersection_volume  # `import cadalign` compiles nothing

    # In a unit of about the boxes' own size no square under- or overflows.
    unit = np.maximum(est.extents.max(axis=-1), gt.extents.max(axis=-1))
    to_est = est.rotation.swapaxes(-1, -2)
    centers = (to_est @ (gt.center - est.center)[..., None])[..., 0] / unit[..., None]
    parts = (
        est.extents / unit[..., None],
        gt.extents / unit[..., None],
        to_est @ gt.rotation,
        centers,
    )
    shapes = ((-1, 3), (-1, 3), (-1, 3, 3), (-1, 3))
    pairs = zip(
        *(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)), strict=True
    )
    shared = np.reshape([intersection_volume(*pair) for pair in pairs], unit.shape)
    # Python's powers: NumPy rounds those of an array otherwise than that of a number.
    cubes = np.reshape([side**3 for side in unit.ravel().tolist()], unit.shape)
    total = (_volumes(est) + _volumes(gt)) / cubes
    return np.asarray(np.clip(shared / (total - shared), 0.0, 1.0))


def _volumes(boxes: BoxArrays) -> FloatArray:
    extents = boxes.extents
    return np.asarray(extents[..., 0] * extents[..., 1] * extents[..., 2])
