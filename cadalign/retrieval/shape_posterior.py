"""Posterior of an object's shape from one image and a shape model, as mixtures of Gaussians.

The reprojection errors are linear in shape and pose about the estimate of `align`. Whitened and
projected to what no change of the pose explains, they read ``A x = b + noise`` of unit covariance,
with the stacked rows x of the shape: each Gaussian of the category is conditioned on that in closed
form, and its weight grows with the probability that it gave to b.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.errors import InputError
from cadalign.estimation.estimates import linearised
from cadalign.estimation.options import FitOptions
from cadalign.estimation.pack import seen_keypoints
from cadalign.estimation.prior import prior_of
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.geometry.camera import faced, turned_alignment
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.marginal.equations import POSE_UNKNOWNS
from cadalign.solvers.marginal.problem import Seen, coordinates_of


class ShapePosterior(NamedTuple):
    """Knowledge of an object's shape from one image and a shape model.

    ``shapes`` is a mixture over stacked rows: x, y, z of each keypoint, then of the box's corners.
    ``log_evidence``, up to a constant, compares shape models that have all keypoints of the image.
    """

    shapes: Gaussians
    log_evidence: float


def shape_posterior(
    result: Result, view: View, *, loss: str = "linear", loss_scale: float = 2.0
) -> ShapePosterior:
    """Posterior of the shape whose alignment with the inliers of one view is ``result``.

    Depths and directions are not used; the ``loss`` weights keypoints by their residuals. Raises
    InputError if the result is not that of a shape model and one view.
    """
    if not isinstance(result.model, ShapeModel) or len(result.poses) != 1:
        what = "expected the alignment of a shape model with one view"
        raise InputError(what, where="result")
    camera, rows_of = faced(view.camera, view.pixels), prior_of(result.model).rows_of
    options = FitOptions(loss=loss, loss_scale=loss_scale)
    names = rows_of(view.keypoint_ids, "view.ids")
    seen = seen_keypoints(replace(view, camera=camera), view.pixels, names, options)
    kept = result.inliers
    seen = Seen(seen.points[kept], seen.rays[kept], seen.whitening[kept], *seen[3:])
    pose = turned_alignment(result.alignment, camera.lens_from_camera.T)
    estimate, columns = np.concatenate([result.points_3d, result.bounds]), coordinates_of(seen)
    errors, rows, by_pose = linearised(estimate[seen.points], pose, seen)
    full, triangle = np.linalg.qr(by_pose, mode="complete")
    rest = full[:, POSE_UNKNOWNS:].T
    rows, right = rest @ rows, rest @ (rows @ estimate[seen.points].ravel() - errors)
    logs, means, covariances = [], [], []
    for weight, mean, covariance in zip(*gaussians_of(result.model), strict=True):
        across = rows @ covariance[columns]
        spread = across[:, columns] @ rows.T + np.eye(len(right))
        gap = right - rows @ mean[columns]
        gain = np.linalg.solve(spread, across).T
        square = float(gap @ np.linalg.solve(spread, gap))
        logs.append(np.log(weight) - 0.5 * (square + np.linalg.slogdet(spread)[1]))
        means.append(mean + gain @ gap)
        covariances.append(covariance - gain @ across)
    total = float(np.logaddexp.reduce(logs))
    shapes = Gaussians(np.exp(np.array(logs) - total), np.array(means), np.array(covariances))
    # The estimate's objective has the log determinant of the shape, linear here: a slope by the
    # keypoints, which moves the means. The box of an estimate is widened to hold what is seen.
    keypoints = result.points_3d.size
    gap = (estimate.ravel() - shapes.means[result.component])[:keypoints]
    own = shapes.covariances[result.component][:keypoints, :keypoints]
    slope = np.linalg.pinv(own, hermitian=True) @ gap
    shifts = shapes.covariances[:, :, :keypoints] @ slope
    moved = Gaussians(shapes.weights, shapes.means + shifts, shapes.covariances)
    pose_volume = float(np.log(np.abs(triangle.diagonal())).sum())
    return ShapePosterior(moved, total - pose_volume)


def gaussians_of(model: ShapeModel) -> Gaussians:
    weights, means, covariances = model.gaussians
    return Gaussians(weights, means.reshape(len(means), -1), covariances)
