"""The meshes whose rims may be those of the object: the model's own, or training models' warped."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.fitting.contours.hull import ConvexSurface
from cadalign.fitting.contours.surface import RigidSurface, Surface, WarpedSurface
from cadalign.fitting.joint.model import Model
from cadalign.geometry.mesh import Mesh
from cadalign.io.meshes.load import load_mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import TrainingShapes

_MOST_MESHES = 3  # training models that are tried, the nearest ones


class Choice(NamedTuple):
    """Surfaces, the likeliest first; ``hulls`` are their convex hulls, none of an exact one."""

    surfaces: list[Surface]
    hulls: list[Surface]


def surfaces_of(model: Model | ShapeModel, points_3d: FloatArray, where: str) -> Choice:
    """Surfaces for a shape whose keypoints are about ``points_3d`` (m, 3), the nearest first.

    Raises
    ------
    InputError
        If there is no mesh; the mask ``where`` wants one.
    DataError
        If a mesh cannot be read.
    """
    if isinstance(model, Model):
        if model.mesh is None:
            fix = "give it: Model(..., mesh=cadalign.datasets.load_mesh(path))"
            raise InputError("the model has no mesh, which a mask wants", where=where, fix=fix)
        if model.shape_sigma is None:
            return Choice([RigidSurface(model.mesh)], [])
        points = cast(FloatArray, model.points_3d)
        return _warped([(model.mesh, points, np.arange(len(points)))])
    nearest = _nearest_with_mesh(model, points_3d, where)
    return _warped([_of_training(alone) for alone in nearest])


def _warped(given: Sequence[tuple[Mesh, FloatArray, IntArray]]) -> Choice:
    return Choice(
        [WarpedSurface(*each) for each in given], [ConvexSurface(*each) for each in given]
    )


def _nearest_with_mesh(
    model: ShapeModel, points_3d: FloatArray, where: str
) -> list[TrainingShapes]:
    """Training models with a mesh, each alone, whose keypoints are nearest."""
    training = model.training
    rows = []
    if training is not None:
        rows = [row for row, path in enumerate(training.mesh_paths) if path is not None]
    if training is None or not rows:
        fix = "learn it from a data set with meshes, such as KeypointNet beside ShapeNet's models"
        raise InputError("no training model has a mesh, which a mask wants", where=where, fix=fix)
    gaps = training.points_3d[rows].astype(np.float64) - points_3d
    squares = (gaps**2).sum(axis=2)
    known = np.isfinite(squares)
    sums = np.where(known, squares, 0.0).sum(axis=1)
    distances = np.where(known.any(axis=1), sums / np.maximum(known.sum(axis=1), 1), np.inf)
    order = np.argsort(distances, kind="stable")[:_MOST_MESHES]
    return [_only(training, rows[k]) for k in order]


def _only(training: TrainingShapes, row: int) -> TrainingShapes:
    return TrainingShapes(
        (training.model_ids[row],), training.points_3d[row : row + 1], (training.mesh_paths[row],)
    )


def _of_training(alone: TrainingShapes) -> tuple[Mesh, FloatArray, IntArray]:
    """The mesh of a training model, its keypoints, and their numbers in the shape."""
    source = alone.points_3d[0].astype(np.float64)
    known = np.flatnonzero(np.isfinite(source).all(axis=1))
    return load_mesh(cast(Path, alone.mesh_paths[0])), source[known], known
