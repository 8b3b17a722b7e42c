"""Annotation without a CAD model: a learned shape's skeleton, and the next keypoint to mark."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.annotate.keypoints import KeypointRegistry, ObjectShape
from cadalign.annotate.model import ClickableModel, MarkedModel
from cadalign.arrays import FloatArray
from cadalign.datasets.model_keypoints import ModelKeypoints
from cadalign.estimation.result import Result
from cadalign.geometry.mesh import Material, Mesh
from cadalign.shapes.model import ShapeModel

_BAR, _JOINT = 0.006, 0.011  # radii [diagonals]
_COLOR = (0.05, 0.09, 0.16, 1.0)


class Skeleton(ClickableModel):
    """The mean keypoints of a learned shape with bars between them; only keypoints are clicked."""

    miss_message = "Click on one of the keypoints, the white points."

    def __init__(self, shape: ShapeModel) -> None:
        points = shape.mean[: len(shape.ids)]
        self._lines = points[np.array(shape.lines, dtype=np.int64).reshape(-1, 2)]
        super().__init__(_mesh(points, self._lines, shape.category))

    @property
    def creases(self) -> FloatArray:
        """The bars' axes, (k, 2, 3) float [model units]."""
        return self._lines

    def pick(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> None:
        """Pick nothing: there is no surface."""


def open_skeleton(shape: ObjectShape) -> MarkedModel:
    """Make the skeleton of a learned shape, with all its keypoints."""
    learned = shape.learned
    assert learned is not None
    registry = KeypointRegistry(fixed=True)
    for point in ModelKeypoints.from_shape(learned).keypoints:
        registry.add(point)
    return MarkedModel(Skeleton(learned), registry, shape)


def next_row(
    points: FloatArray, marked: Sequence[int], left: Sequence[int], result: Result | None
) -> int | None:
    """Choose the keypoint to mark next among the rows ``left``; None if there is none.

    With a result, it is the keypoint in the photo of the largest predicted standard deviation [px].
    Before, it is the keypoint farthest from the ``marked`` ones, or at first from the centre.
    """
    rows = np.array(left, dtype=np.int64)
    if result is not None and result.points_cam_covariance is not None:
        in_camera = result.alignment.apply(result.points_3d)[rows]
        seen = result.camera.sees(in_camera)
        if not seen.any():
            return None
        covariances = result.points_cam_covariance[rows[seen]]
        places = result.camera.projected_covariances(in_camera[seen], covariances)
        return int(rows[seen][np.trace(places, axis1=1, axis2=2).argmax()])
    if not len(rows):
        return None
    known = points[list(marked)] if marked else points.mean(axis=0, keepdims=True)
    gaps = np.linalg.norm(points[rows][:, None] - known[None], axis=2).min(axis=1)
    return int(rows[gaps.argmax()])


def _mesh(points: FloatArray, lines: FloatArray, name: str) -> Mesh:
    """Make a ball at each point (m, 3), and a bar along each line (k, 2, 3)."""
    import trimesh  # takes time

    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    balls = [trimesh.creation.icosphere(subdivisions=0, radius=_JOINT * size) for _ in points]
    for ball, point in zip(balls, points, strict=True):
        ball.apply_translation(point)
    bars = [trimesh.creation.cylinder(_BAR * size, segment=line, sections=6) for line in lines]
    whole: Any = trimesh.util.concatenate([*balls, *bars])
    return Mesh(whole.vertices, whole.faces, materials=(Material(color=_COLOR),), source=name)
