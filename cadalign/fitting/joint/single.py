"""One view of keypoints of a learned shape: the search with the shape eliminated."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.fitting.alternatives import LEAST_LIKELIHOOD
from cadalign.fitting.joint.agreement import summary_of_keypoints
from cadalign.fitting.joint.boxes import with_boxes
from cadalign.fitting.joint.deviations import curvature_of_rotations
from cadalign.fitting.joint.estimates import is_other, stretch_of
from cadalign.fitting.joint.prior import rows_among
from cadalign.fitting.joint.result import AlignAlternative, AlignResult
from cadalign.fitting.joint.single_basis import SingleBasis
from cadalign.fitting.joint.view import View
from cadalign.fitting.joint.warnings import another_pose, misfits, weaknesses
from cadalign.fitting.noise import rays_of, whitening_of
from cadalign.fitting.options import LOSSES, FitOptions
from cadalign.fitting.result import FitStats
from cadalign.geometry.alignment import Alignment
from cadalign.shapes.inflation import inflation_with
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.marginal.directions import find_directions
from cadalign.solvers.marginal.equations import POSE_UNKNOWNS
from cadalign.solvers.marginal.moments import moments_of
from cadalign.solvers.marginal.posterior import posteriors_of
from cadalign.solvers.marginal.problem import Mixture, Seen
from cadalign.solvers.marginal.search import search_view

_LEAST_POINTS = 3


def is_single(model: object, views: Sequence[View]) -> bool:
    """True where nothing but the keypoints of one view and a learned shape is given."""
    if not isinstance(model, ShapeModel) or len(views) != 1:
        return False
    view = views[0]
    others = (view.depth, view.up, view.cam_from_rig, view.mask, view.camera_height)
    return len(view.keypoint_ids) >= _LEAST_POINTS and all(each is None for each in others)


def align_single(
    model: ShapeModel, view: View, *, options: FitOptions, init: Alignment | None
) -> AlignResult:
    """The result of `cadalign.align` where `is_single` holds.

    Raises
    ------
    InputError
        If the view names a keypoint that the model lacks.
    DegenerateError
        If no pose has all keypoints in front of the camera.
    """
    start = time.perf_counter()
    rows = rows_among(model.ids, view.keypoint_ids, "views[0].ids")
    means, covariances, weights = model.gaussians
    mixture = Mixture(means, covariances, -2 * np.log(weights))
    seen = _seen(view, rows, options)
    minima, count, iterations, hypotheses = search_view(mixture, seen, _given(init))
    if not count:
        raise DegenerateError(
            "no pose has the keypoints in front of the camera",
            where="views",
            fix="give `init`, and check which keypoint is which",
        )
    minima, count = find_directions(mixture, seen, minima, count)
    stats = FitStats(iterations, hypotheses, time.perf_counter() - start)
    likelihoods = np.exp((minima.scores[0] - minima.scores[:count]) / 2)
    likelihoods = likelihoods[likelihoods >= LEAST_LIKELIHOOD]
    boxed = mixture, minima
    if model.box_margins is not None:
        boxed = with_boxes(mixture, seen, minima, len(likelihoods), model.box_margins)
    inflation = inflation_with(len(rows), model.inflation, model.few_keypoints)
    likely = posteriors_of(boxed[0], seen, boxed[1], likelihoods, inflation)
    moments = moments_of(likely)
    if covariances.any():
        turns = moments.covariance[:3, :3]
        turns += curvature_of_rotations(turns)
    points, alignment = likely.points[0], _alignment(likely.poses[0])
    in_camera = alignment.apply(points[rows])
    of_mean = weights @ (means[:, -1] - means[:, -2])
    alternatives = tuple(
        AlignAlternative(
            _alignment(likely.poses[k]),
            likely.points[k, :-2],
            likely.points[k, -2:],
            float(likelihoods[k]),
        )
        for k in range(1, len(likelihoods))
        if is_other(moments, k)
    )
    warnings = weaknesses(alignment, moments.covariance)
    if seen.loss == LINEAR:
        warnings += misfits(float(minima.costs[0]), 2 * len(rows) - POSE_UNKNOWNS)
    errors = in_camera[:, :2] / in_camera[:, 2:] - seen.rays
    component = int(minima.component[0])
    return AlignResult(
        alignment=alignment,
        ids=model.ids,
        points_3d=points[:-2],
        bounds=points[-2:],
        poses=(alignment,),
        residuals=(view.camera.project(in_camera) - cast(FloatArray, view.points_2d),),
        inliers=(np.ones(len(rows), dtype=bool),),
        covariance=moments.covariance,
        points_covariance=moments.of_points[:-2],
        points_cam_covariance=moments.of_seen[:-2],
        stretch=stretch_of(likely.lengths[0], of_mean),
        component=component,
        model=model,
        alternatives=alternatives,
        warnings=(*warnings, *another_pose(alignment, alternatives)),
        stats=stats,
        evidence=(summary_of_keypoints(errors, seen.whitening, 0, view.camera),),
        basis=SingleBasis(
            model, view, options, component, minima.poses[0].copy(), minima.forces[0].copy()
        ),
        cameras=(view.camera,),
        observed=(cast(FloatArray, view.points_2d),),
        degrees_of_freedom=model.degrees_of_freedom,
    )


def _seen(view: View, rows: list[int], options: FitOptions) -> Seen:
    pixels = cast(FloatArray, view.points_2d)
    rays = rays_of(np.require(pixels, requirements="W"), view.camera)
    whitening = np.empty((len(rows), 3))
    whitening[:] = whitening_of(view.sigma, rays, view.camera)
    loss, scale = LOSSES[options.loss], float(options.loss_scale)
    return Seen(np.array(rows, dtype=np.int64), rays, whitening, loss, scale)


def _given(init: Alignment | None) -> FloatArray:
    """A given start as a pose (1, 12) of the unstretched shape; none (0, 12) without."""
    if init is None:
        return np.empty((0, 12))
    translation = init.translation / init.scale.mean()
    return np.concatenate([init.rotation.ravel(), translation])[None]


def _alignment(pose: FloatArray) -> Alignment:
    """A pose (12,) of the unstretched shape."""
    return Alignment(pose[:9].reshape(3, 3), pose[9:], np.ones(3), is_valid=True)
