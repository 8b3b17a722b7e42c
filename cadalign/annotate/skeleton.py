"""Annotation without a CAD model: a learned shape's skeleton, and the next keypoint to mark."""

from __future__ import annotations

from collections.abc import Sequence

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
_OCTAHEDRON = np.array([[x, y, z] for x in (0, 1) for y in (2, 3) for z in (4, 5)], dtype=np.int64)
_PRISM = np.array(
    [[k, (k + 1) % 6, 6 + k] for k in range(6)]
    + [[6 + k, 6 + (k + 1) % 6, (k + 1) % 6] for k in range(6)]
)


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
    """Make an octahedron at each point (m, 3), and a bar along each line (k, 2, 3)."""
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    corners = np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
    parts = [(point + _JOINT * size * corners, _OCTAHEDRON) for point in points]
    turns = np.linspace(0, 2 * np.pi, 6, endpoint=False)[:, None]
    for start, end in lines:
        along = end - start
        side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
        if not side.any():  # the keypoints coincide
            continue
        side /= np.linalg.norm(side)
        other = np.cross(along, side) / np.linalg.norm(along)
        ring = _BAR * size * (np.cos(turns) * side + np.sin(turns) * other)
        parts.append((np.concatenate([start + ring, end + ring]), _PRISM))
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return Mesh(
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([first + faces for first, (_, faces) in zip(firsts, parts, strict=False)]),
        materials=(Material(color=_COLOR),),
        source=name,
    )
