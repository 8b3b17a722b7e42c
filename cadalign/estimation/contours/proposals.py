"""Starts of an estimate from a mask alone: alignments whose silhouettes resemble it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.contours.descent import Masked, approached
from cadalign.estimation.contours.silhouettes import Resembling, differ, resembling_poses
from cadalign.estimation.contours.surface import Surface, surfaces_of
from cadalign.estimation.contours.view_contour import ViewContour, contour_view
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.model import Model
from cadalign.estimation.search import JointProblem, Minimum, find_minima
from cadalign.geometry.mesh import Mesh
from cadalign.io.meshes.load import load_mesh
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import TrainingShapes

_MOST_STARTS = 40
_FEW_STARTS = 12  # that are enough where one of them meets the mask
_MOST_SIMILAR_STARTS = 12  # of models that are only similar, whose surfaces are warped
_MOST_MESHES = 4  # of a learned shape's training models
_MOST_COMPARED = 100  # of these
_MEETS = 0.003  # misfit of such a start, relative to the mask's size
_MEETS_PX = 0.5
_FAR = 0.01  # misfit, relative to the mask's size, of a model that may be another
_FAR_PX = 2.0
_MOST_PROPOSALS = 4
_CLOSE = 3.0  # misfit, relative to the least, at which a proposal is still one
_CLOSE_PX = 3.0
_WHERE = "views[0].mask"


class _Proposal(NamedTuple):
    """A minimum near the mask, and the mean distance [px] of the mask's contour from its rim."""

    minimum: Minimum
    misfit: float


class MaskProposals(NamedTuple):
    """Minima near a mask, the best first; numbers of iterations and of starts, and a mistake."""

    minima: list[Minimum]
    iterations: int
    starts: int
    mistake: str | None


class _Silhouetted(NamedTuple):
    """An alignment whose silhouette resembles the mask, and the surface that it is of."""

    resembling: Resembling
    surface: Surface


def minima_of_mask(problem: JointProblem, model: Model | ShapeModel) -> MaskProposals:
    """Minima of the evidence beside the mask of the only view, at alignments that resemble it.

    Of a model that is only similar, and of a learned shape, they are proposals: another shape in
    another pose has an outline alike.

    Raises InputError if the mask has no contour, the model no mesh, or the focal length is unknown.
    """
    (view,), camera = problem.views, problem.lenses.cameras[0]
    if not view.camera.focal_known:
        raise InputError(
            "a mask alone does not tell the focal length",
            where="views[0].camera",
            fix="give a calibrated camera, or keypoints",
        )
    contour = contour_view(0, view, _WHERE, camera)
    silhouetted = _silhouetted(problem, model)
    is_exact = isinstance(model, Model) and model.shape_sigma is None
    proposals: list[_Proposal] = []
    steps, starts, least = 0, 0, np.inf
    for each in silhouetted:
        found, iterations = _approached(problem, each, contour)
        steps += iterations
        if found is not None:
            proposals.append(found)
        starts += 1
        least = min((each.misfit for each in proposals), default=np.inf)
        is_met = least < max(_MEETS_PX, _MEETS * contour.contour.size)
        if is_exact and is_met and starts >= _FEW_STARTS:
            break
    mistake = None
    if not is_exact:
        mistake = (
            f"{_WHERE} alone does not tell the pose of an object that is only similar: the "
            "estimate is a proposal, as its alternatives are, and three keypoints settle it"
        )
    elif least > max(_FAR_PX, _FAR * contour.contour.size):
        mistake = (
            f"{_WHERE}: no pose found brings the outline closer to the mask's than "
            f"{least:.1f} px on average: the model may be another, the mask incomplete, or the "
            "pose wrong"
        )
    chosen = [each.minimum for each in _chosen(proposals)]
    return MaskProposals(chosen, steps, starts, mistake)


def _silhouetted(problem: JointProblem, model: Model | ShapeModel) -> list[_Silhouetted]:
    """Alignments whose silhouettes resemble the mask, of all meshes, the best first."""
    (view,), camera = problem.views, problem.lenses.cameras[0]
    free = np.asarray(problem.prior.scales.free > 0)
    mask = cast(FloatArray, view.mask_image)
    is_exact = isinstance(model, Model) and model.shape_sigma is None
    count = _MOST_STARTS if is_exact else _MOST_SIMILAR_STARTS
    found = [
        _Silhouetted(each, surface)
        for mesh, surface in _meshes_of(model)
        for each in resembling_poses(mesh, mask, camera, free=free, count=count)
    ]
    return sorted(found, key=lambda each: -each.resembling.iou)[:count]


def _approached(
    problem: JointProblem, start: _Silhouetted, contour: ViewContour
) -> tuple[_Proposal | None, int]:
    """The minimum near a start, its outline brought to the mask's; and the iterations."""
    _, minima, iterations, _ = find_minima(problem, [start.resembling.alignment], None)
    if not minima:
        return None, iterations
    best = minima[0]
    masked = Masked(best.evidence, len(problem.prior.ids), [contour], start.surface)
    found = approached(masked, best.state)
    if found is None:
        return None, iterations
    return _Proposal(best._replace(state=found.state), found.misfit), iterations


def _meshes_of(model: Model | ShapeModel) -> list[tuple[Mesh, Surface]]:
    """Meshes with their surfaces: the model's, or those of varied training models."""
    if isinstance(model, Model):
        points = cast(FloatArray, model.points_3d)
        return [(cast(Mesh, model.mesh), surfaces_of(model, points, _WHERE).surfaces[0])]
    mean = model.components[0].mean[: len(model.ids)]
    surfaces_of(model, mean, _WHERE)  # refuses a model without meshes
    training = cast(TrainingShapes, model.training)
    found = []
    for row in _varied(training, mean):
        points = training.points_3d[row].astype(np.float64)
        surface = surfaces_of(model, points, _WHERE).surfaces[0]
        found.append((_mesh_at(cast(Path, training.mesh_paths[row])), surface))
    return found


def _varied(training: TrainingShapes, mean: FloatArray) -> list[int]:
    """Rows of training models with meshes: the nearest to the mean, and those far from others."""
    rows = [row for row, path in enumerate(training.mesh_paths) if path is not None]
    rows = rows[:: 1 + len(rows) // _MOST_COMPARED]
    points = training.points_3d[rows].astype(np.float64)
    points = np.where(np.isfinite(points), points, mean)
    gaps = np.linalg.norm(points[:, None] - points[None], axis=3).mean(axis=2)
    chosen = [int(np.linalg.norm(points - mean, axis=2).mean(axis=1).argmin())]
    while len(chosen) < min(_MOST_MESHES, len(rows)):
        chosen.append(int(gaps[:, chosen].min(axis=1).argmax()))
    return [rows[k] for k in chosen]


@lru_cache(maxsize=16)
def _mesh_at(path: Path) -> Mesh:
    return load_mesh(path)  # one object, for which silhouettes are rendered once


def _chosen(proposals: list[_Proposal]) -> list[_Proposal]:
    """The distinct proposals that come about as close to the mask as the best."""
    kept: list[_Proposal] = []
    for each in sorted(proposals, key=lambda proposal: proposal.misfit):
        if kept and each.misfit > max(_CLOSE * kept[0].misfit, kept[0].misfit + _CLOSE_PX):
            break
        (pose,) = poses_of(each.minimum.evidence, each.minimum.state)
        known = [poses_of(other.minimum.evidence, other.minimum.state)[0] for other in kept]
        if all(differ(pose, other) for other in known):
            kept.append(each)
    return kept[:_MOST_PROPOSALS]
