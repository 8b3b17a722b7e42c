"""Meshes of results: a model's, warped to the object's keypoints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cadalign.errors import InputError
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import NearestShape
from cadalign.shapes.warp import warp_mesh

if TYPE_CHECKING:
    from cadalign.estimation.result import Result


def known_mesh(result: Result, mesh: Mesh | None) -> Mesh | None:
    """The object's mesh from a given one or the model's own; None where there is none."""
    known = mesh if mesh is not None else getattr(result.model, "mesh", None)
    return None if known is None else warped_mesh(result, known)


def warped_mesh(result: Result, mesh: Mesh | None) -> Mesh:
    """The object's mesh; see `cadalign.Result.mesh`."""
    model = result.model
    if isinstance(model, ShapeModel):
        if mesh is None:
            fix = "give that of the training model `nearest`, read from its mesh_path"
            raise InputError("a learned shape has no mesh of its own", where="mesh", fix=fix)
        source = nearest_shape(result).points_3d
        known = np.isfinite(source).all(axis=1)
        return warp_mesh(mesh, source[known], result.points_3d[known], bounds=result.bounds)
    given = mesh if mesh is not None or model is None else model.mesh
    if given is None:
        raise InputError("the model has no mesh", where="mesh", fix="give one")
    if model is None or model.shape_sigma is None:
        return given
    return warp_mesh(given, model.points_3d, result.points_3d, bounds=result.bounds)


def nearest_shape(result: Result) -> NearestShape:
    """The nearest training model; see `cadalign.Result.nearest`."""
    if not isinstance(result.model, ShapeModel):
        raise InputError("only a learned shape has training models", where="model")
    return result.model.nearest(result.points_3d)
