"""Ranking of what to add to a photo's pairs: the suggested keypoint, a mask, a photo, lengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.annotate.model import CadModel
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.evaluation.simulation.problems import Problem
from cadalign.fitting.joint.advice import Advice, rank_evidence
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.view import View
from cadalign.fitting.result import FitResult
from cadalign.geometry.alignment import Alignment
from cadalign.render.raycast.renderer import cast_geometry

_SUGGESTED = "suggested"


@dataclass(frozen=True, eq=False)
class Marked:
    """The pairs of a photo as they are fitted: (n, 3) model units, (n, 2) and (n,) px."""

    points_3d: FloatArray
    points_2d: FloatArray
    sigma: FloatArray


def rank(
    model: CadModel, marked: Marked, result: FitResult, suggestion: Suggestion | None
) -> tuple[Advice, ...]:
    """Rank the suggested keypoint, a mask, another photo and lengths; empty if nothing is known."""
    mesh, bounds = model.scene.mesh, model.scene.bounds
    camera, alignment = result.camera, result.alignment
    ids = tuple(range(len(marked.points_3d)))
    suggested = [] if suggestion is None else [suggestion.point.xyz]
    candidates = (_SUGGESTED,) * len(suggested)
    exact = Model(
        points_3d=np.vstack([marked.points_3d, *suggested]),
        ids=(*ids, *candidates),
        bounds=bounds,
        mesh=mesh,
    )
    view = View(camera, marked.points_2d, ids=ids, sigma=marked.sigma)
    mask = cast_geometry(model.scene, camera, alignment).mask
    try:
        ranked = rank_evidence(exact, view, alignment, candidates=candidates, mask=mask)
    except CadalignError:
        # Of an object beyond the image's borders no contour is seen.
        ranked = _without_mask(exact, view, alignment, candidates)
    return tuple(each for each in ranked if np.isfinite(each.worst))


def _without_mask(
    model: Model, view: View, alignment: Alignment, candidates: tuple[str, ...]
) -> tuple[Advice, ...]:
    try:
        return rank_evidence(model, view, alignment, candidates=candidates)
    except CadalignError:
        return ()


def warm_up_advice(problem: Problem) -> None:
    """Compile or load what `rank` calls, by ranking what would help a synthetic problem."""
    view = View(problem.camera, problem.points_2d)
    rank_evidence(Model(points_3d=problem.points_3d), view, problem.alignment)
