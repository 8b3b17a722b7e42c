"""One view of keypoints, the cases that need no joint search.

`fit` solves an exact or stretched model; of a learned shape, the search eliminates the shape.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.estimates import as_given
from cadalign.estimation.fit import fit_one
from cadalign.estimation.joint import result_of
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.pack import seen_keypoints
from cadalign.estimation.prior import prior_of
from cadalign.estimation.problem import Problem, no_pose_error
from cadalign.estimation.problems import pack_one
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import LEAST_LIKELIHOOD, FitStats
from cadalign.estimation.uncertainty.shape_posterior import single_posterior
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import turned_alignment
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import inflation_with
from cadalign.solvers.constants import LEAST_POINTS
from cadalign.solvers.marginal.equations import POSE_UNKNOWNS
from cadalign.solvers.marginal.problem import Mixture
from cadalign.solvers.marginal.search import search_view


def is_plain(model: object, views: Sequence[View]) -> bool:
    """True where nothing but the keypoints of one view and an exact model is given."""
    return is_exact_model(model) and len(views) == 1 and not views[0].sources


def is_single(problem: Problem) -> bool:
    """True where nothing but the keypoints of one view and a learned shape is given."""
    if problem.numbers != [0] or not isinstance(problem.model, ShapeModel):
        return False
    view = problem.views[0]
    if view.sources or view.sigma is None or len(view.keypoint_ids) < LEAST_POINTS:
        return False
    return problem.size is None and problem.ransac is None and not problem.lenses.count


def align_plain(
    model: Model, view: View, *, options: FitOptions, ransac: RansacOptions | None
) -> Result:
    """The result of `fit`, with all keypoints of the model."""
    start, points = time.perf_counter(), cast(FloatArray, model.points_3d)
    rows = prior_of(model).rows_of(view.keypoint_ids, "views[0].ids")
    shape = {name: getattr(model, name) for name in ("stretch", "stretch_sigma", "known_axis")}
    own = replace(options, sigma=view.sigma, **shape)
    problems = pack_one(points[rows], view.pixels, view.camera)
    scores = view.scores if ransac is not None else None
    return fit_one(problems, own, ransac, scores, model.symmetry, start, model=model, view=view)


def align_single(problem: Problem, start: float) -> Result:
    """The result of `cadalign.align` where `is_single` holds, which was begun at ``start`` [s]."""
    model, view, options = cast(ShapeModel, problem.model), problem.views[0], problem.options
    prior, init = problem.prior, problem.inits[0]
    if init is not None:
        init = turned_alignment(init, problem.turns[0].T)
    rows = prior.rows_of(view.keypoint_ids, f"views[{view.number}].ids")
    weights, means, covariances = model.gaussians
    mixture = Mixture(means, covariances, -2 * np.log(weights))
    seen = seen_keypoints(view, view.pixels, rows, options)
    minima, hypotheses = search_view(mixture, seen, _given(init))
    count, iterations = minima.counts.tolist()
    if not count:
        raise no_pose_error(problem)
    stats = FitStats(iterations, hypotheses, time.perf_counter() - start)
    likelihoods = np.exp((minima.scores[0] - minima.scores[:count]) / 2)
    likelihoods = likelihoods[likelihoods >= LEAST_LIKELIHOOD]
    inflation = inflation_with(len(rows), model.inflation, model.few_keypoints)
    kept = zip(likelihoods.tolist(), minima.label.tolist(), minima.states, strict=False)
    boxes = model if covariances.any() else None
    estimates = [
        single_posterior(mixture, component, seen, state, inflation, boxes)._replace(
            likelihood=likelihood, cameras=(view.camera,)
        )
        for likelihood, component, state in kept
    ]
    component, cost = int(minima.label[0]), float(minima.costs[0])

    return result_of(
        problem,
        [as_given(each, problem) for each in estimates],
        inliers=[np.ones(len(rows), dtype=bool)],
        is_curved=bool(covariances.any()),
        redundancy=2 * len(rows) - POSE_UNKNOWNS,
        cost=cost,
        stats=stats,
        component=component,
        known_axis=None,
        stretched_axes="",
    )


def _given(init: Alignment | None) -> FloatArray:
    if init is None:
        return np.empty((0, 12))
    return np.append(init.rotation, init.translation / init.scale.mean())[None]
