"""Ranking of what to add to a photo's pairs: the suggested keypoint, a mask, a photo, lengths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cadalign.annotate.model import ClickableModel
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.advice import Advice, rank_evidence
from cadalign.estimation.view import View
from cadalign.evaluation.simulation.problems import Problem
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.raycast.renderer import cast_geometry

_SUGGESTED = "suggested"
# Of the photo's longer side [px]: segmentation sees no more, and its errors grow with the photo.
_MASKED_AT = 1280


@dataclass(frozen=True, eq=False)
class Marked:
    """The pairs of a photo as they are fitted: (n, 3) model units, (n, 2) and (n,) px."""

    points_3d: FloatArray
    points_2d: FloatArray
    sigma: FloatArray


def rank(
    model: ClickableModel, marked: Marked, result: Result, suggestion: Suggestion | None
) -> tuple[Advice, ...]:
    """Rank the suggested keypoint, a mask, another photo and lengths; empty if nothing is known.

    The pairs count as much as the deviations of the result say, which are calibrated for few of
    them. Masks are predicted for a photo of at most 1280 px.
    """
    scene = model.light_scene
    alignment = result.alignment
    times = max(1.0, max(result.camera.width, result.camera.height) / _MASKED_AT)
    camera = _reduced(result.camera, times)
    ids = tuple(range(len(marked.points_3d)))
    suggested = [] if suggestion is None else [suggestion.point.xyz]
    candidates = (_SUGGESTED,) * len(suggested)
    exact = Model(
        points_3d=np.vstack([marked.points_3d, *suggested]),
        ids=(*ids, *candidates),
        bounds=model.scene.bounds,
        mesh=scene.mesh,
        scale_prior_sigma=None if result.options is None else result.options.scale_prior_sigma,
    )
    sigma = _widening(result) * marked.sigma / times
    view = View(camera, _reduced_pixels(marked.points_2d, times), ids=ids, sigma=sigma)
    mask = cast_geometry(scene, camera, alignment).mask
    try:
        ranked = rank_evidence(exact, view, alignment, candidates=candidates, mask=mask)
    except CadalignError:
        # Of an object beyond the image's borders no contour is seen.
        ranked = _without_mask(exact, view, alignment, candidates)
    return tuple(each for each in ranked if np.isfinite(each.worst))


def _reduced(camera: Camera, times: float) -> Camera:
    """The camera of the photo at 1 / times its size."""
    ((cx, cy),) = _reduced_pixels(np.array([[camera.cx, camera.cy]]), times).tolist()
    return replace(
        camera,
        width=max(1, round(camera.width / times)),
        height=max(1, round(camera.height / times)),
        fx=camera.fx / times,
        fy=camera.fy / times,
        cx=cx,
        cy=cy,
    )


def _reduced_pixels(pixels: FloatArray, times: float) -> FloatArray:
    return np.asarray((pixels + 0.5) / times - 0.5)


def _widening(result: Result) -> float:
    """Mean ratio of the deviations to those of the linearised problem."""
    linear, calibrated = result.fisher_covariance, result.covariance
    if linear is None or calibrated is None:
        return 1.0
    known = linear.diagonal() > 0
    return float(np.sqrt(np.mean(calibrated.diagonal()[known] / linear.diagonal()[known])))


def present(result: Result) -> Advice | None:
    """The deviations as they are, without any addition."""
    std = result.std
    if std is None:
        return None
    distance = float(np.linalg.norm(result.alignment.translation))
    position = float(np.linalg.norm(std.translation)) / distance
    return Advice("nothing", "", std.rotation_deg, position, std.scale)


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
