"""Keypoints of one view by the joint system: where the focal length is an unknown, too."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt

from cadalign.errors import DegenerateError
from cadalign.estimation.estimates import pose_and_lengths, poses_of
from cadalign.estimation.joint import common_sigma
from cadalign.estimation.model import Model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.problem import compile_problem
from cadalign.estimation.problems import Problems, no_alignment_error, too_few_error
from cadalign.estimation.result_parts import FitStats, FittedKeypoints, alternatives_of
from cadalign.estimation.search import search
from cadalign.estimation.view import View
from cadalign.geometry.alignment import describe_plane
from cadalign.solvers.joint.covariance import joint_covariance, pose_and_border


def fit_jointly(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions | None,
    scores: npt.ArrayLike | None,
    start: float,
) -> FittedKeypoints:
    """Fit the only problem, with ``ransac`` its inliers, which was begun at ``start`` [s].

    Raises DegenerateError if no minimum is determined; NoConsensusError as `search`.
    """
    points, pixels = problems.points_3d.copy(), problems.points_2d
    if len(points) < options.min_points:
        raise too_few_error(len(points), options)
    model = Model(
        points_3d=points,
        stretch=options.stretch,
        stretch_sigma=options.stretch_sigma,
        known_axis=options.known_axis,
    )
    view = View(problems.camera, pixels, sigma=options.sigma, scores=scores)
    compiled = compile_problem(model, [view], None, [None], options, ransac)
    problem, minima, iterations, hypotheses = search(compiled, [[None]])
    if ransac is None:  # the optimum comes first, whatever its volume
        minima = sorted((each._replace(score=each.cost) for each in minima), key=lambda m: m.score)
    if not minima:
        raise no_alignment_error()
    best = minima[0]
    costs = [each.score for each in minima]
    poses = [poses_of(each.evidence, each.state)[0] for each in minima]
    cameras = [each.lenses.cameras_at(each.state.log_focals)[0] for each in minima]
    found = joint_covariance(best.evidence, best.state)
    covariance = pose_and_lengths(best.evidence, best.state, pose_and_border(found, 0))
    if not np.isfinite(covariance).all():
        raise DegenerateError(
            "the alignment is not determined"
            + (f": {why}" if (why := describe_plane(points)) else ""),
            where="points_3d",
            fix="add keypoints elsewhere, hold scales with stretch=, or give a prior",
        )
    residuals = cameras[0].project_where_ahead(poses[0].apply(points)) - pixels
    stats = FitStats(iterations, hypotheses, time.perf_counter() - start)
    return FittedKeypoints(
        points,
        residuals,
        best.inliers,
        poses[0],
        cameras[0],
        options,
        sigma=problem.noise if problem.lacks_sigma else common_sigma([view]),
        fisher_covariance=covariance,
        cost=best.cost,
        alternatives=alternatives_of(points, poses, cameras, costs),
        method="optimal" if ransac is None else "ransac-optimal",
        stats=stats,
    )
