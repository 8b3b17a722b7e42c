"""Robust search: the alignment with the most inliers, by LO-RANSAC over the minimal solver."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.assemble import result_of_keypoints
from cadalign.estimation.consensus import Support, area_of, check_support, order_of_confidence
from cadalign.estimation.focal import log_focal_range
from cadalign.estimation.focal_search import focal_views
from cadalign.estimation.options import MINIMAL_SOLVERS, FitOptions, RansacOptions
from cadalign.estimation.problems import Problems, are_in_one_plane, rays_of, whitening_of
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import FitStats
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.alignment import Objective
from cadalign.solvers.constants import LINEAR, POSE_SIZE, SAMPLE_SIZES
from cadalign.solvers.evidence import Keypoints, LogFocalPrior, ScalePrior, Views
from cadalign.solvers.ransac import Settings, ransac_kernel

_MOST_EXHAUSTIVE = 1000  # subsets that are all tried rather than drawn from


def find_consensus(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions,
    confidences: npt.ArrayLike | None,
) -> Result:
    """The best hypothesis of LO-RANSAC for the only problem, with its inliers.

    Raises
    ------
    NoConsensusError
        If no alignment has more support than chance gives; it carries the best score reached.
    """
    camera = problems.cameras[0]
    points = problems.points_3d[:, options.axis_order]
    count = len(points)
    minimal = MINIMAL_SOLVERS[ransac.minimal]
    size = SAMPLE_SIZES[minimal]
    if count < size:
        raise InputError(
            f"{count} keypoints are too few", where="points_3d", fix=f"give at least {size}"
        )
    if options.focal == "estimate" and ransac.minimal != "ap4p":
        raise InputError(
            f"{ransac.minimal!r} does not estimate the focal length",
            where="minimal",
            fix="leave it at 'ap4p'",
        )
    by_confidence = order_of_confidence(confidences, count)
    order = np.random.default_rng(ransac.seed).permutation(count)
    ranked = np.arange(count) if by_confidence is None else np.argsort(order)[by_confidence]
    views = _views(problems.points_2d[order], camera, options)
    exhaustive = math.comb(count, size) <= _MOST_EXHAUSTIVE
    pose = np.zeros(POSE_SIZE)
    inliers = np.zeros(count, dtype=bool)
    score, log_focal, iterations, hypotheses = ransac_kernel(
        Objective(
            options.free,
            Keypoints(
                np.ascontiguousarray(points[order]), views.rays[0], views.whitening[0], LINEAR, 1.0
            ),
            ScalePrior(options.prior_weight),
        ),
        views,
        np.log(views.focals),
        LogFocalPrior(*log_focal_range(camera, options.focal_prior)),
        ranked,
        Settings(
            threshold=float(ransac.max_reproj_error),
            minimal=minimal,
            size=size,
            max_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.max_iterations),
            min_iterations=_MOST_EXHAUSTIVE if exhaustive else int(ransac.min_iterations),
            success_prob=float(ransac.success_prob),
            seed=int(ransac.seed),
            exhaustive=exhaustive,
            guided=by_confidence is not None,
            optimize=ransac.refine,
            estimate_focal=options.focal == "estimate",
        ),
        pose,
        inliers,
    )
    if not hypotheses and are_in_one_plane(points):
        raise DegenerateError(
            "all keypoints lie in one plane, where the samples of ransac determine nothing",
            where="points_3d",
            fix="leave ransac away: use loss='cauchy', with stretch= or scale_prior_sigma=",
        )
    if options.focal == "estimate":
        camera = camera.with_focal(math.exp(log_focal))
    alignment = Alignment.from_packed(options.in_model_axes(pose))
    kept = np.empty(count, dtype=bool)
    kept[order] = inliers
    residuals = residuals_of(problems, alignment, camera)
    check_support(
        [
            Support(
                np.linalg.norm(residuals[kept], axis=1),
                count,
                area_of(problems.points_2d, camera, ransac.max_reproj_error),
            )
        ],
        size + (options.focal == "estimate"),  # which half a keypoint determines
        max_reproj_error=ransac.max_reproj_error,
        score=float(score),
        where="points_2d",
    )
    stats = FitStats(int(iterations), int(hypotheses), 0.0, float(kept.mean()), float(score))
    fitted = {
        "points_3d": problems.points_3d.copy(),
        "residuals": residuals,
        "inliers": kept,
        "alignment": alignment,
        "camera": camera,
        "options": options,
    }
    method = f"ransac-{ransac.minimal}"
    return result_of_keypoints(problems.points_2d, fitted, method=method, stats=stats)


def _views(points_2d: FloatArray, camera: Camera, options: FitOptions) -> Views:
    """Rays and weights, in pixels, at the camera's focal length or at those to be tried."""
    if options.focal == "estimate":
        return focal_views(points_2d, camera, options.focal_prior, None)
    camera.require_focal()
    rays = rays_of(points_2d, camera)
    return Views(np.array([camera.fx]), rays[None], whitening_of(1.0, rays, camera)[None])


def residuals_of(problems: Problems, alignment: Alignment, camera: Camera) -> FloatArray:
    """Projected minus observed keypoints (n, 2) of the only problem; infinite behind the camera."""
    projected = camera.project_where_ahead(alignment.apply(problems.points_3d))
    return projected - problems.points_2d
