"""Posterior of an object's whole shape: all keypoints and the box, jointly, given one image.

The reprojection errors are linear in shape and pose about the estimate of `align`. Whitened and
projected to what no change of the pose explains, they read ``A x = b + noise`` of unit covariance,
with the stacked rows x of the shape: each Gaussian of the category is conditioned on that in closed
form, and its weight grows with the probability that it gave to b.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.facing import faced, turned_alignment
from cadalign.estimation.options import LOSSES
from cadalign.estimation.prior import prior_of
from cadalign.estimation.problems import rays_of, whitening_of
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.held_out import whitened_errors
from cadalign.estimation.view import View
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.evidence import loss_and_root

_POSE = 6


@dataclass(frozen=True, eq=False)
class ShapePosterior:
    """Knowledge of an object's shape from one image and a shape model.

    ``shapes`` is a mixture over the stacked rows: x, y, z of each keypoint of the shape model, then
    of the least and the greatest corner of the box [model units]. ``log_evidence`` is the log of
    the probability density of the image's whitened keypoints, up to a constant, given that the
    object is of the category: it compares shape models that have all of them.
    """

    shapes: Gaussians
    log_evidence: float


def shape_posterior(
    result: Result, view: View, *, loss: str = "linear", loss_scale: float = 2.0
) -> ShapePosterior:
    """Posterior of the shape whose alignment with one view's keypoints is ``result``.

    Parameters
    ----------
    result : Result
        `align` of a `ShapeModel` with ``view`` alone. Its outliers are left out.
    view : View
        The keypoints; depths and directions are not used.
    loss, loss_scale
        Loss of the alignment: it weights the keypoints by their residuals.

    Raises
    ------
    InputError
        If the result is not that of a shape model and one view.

    Examples
    --------
    The front side of a box that is as deep as it is wide determines the depth:

    >>> from cadalign import Alignment, Camera, align
    >>> corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    >>> model = ShapeModel.from_basis(corners, [corners * [1, 0, 1]], [0.2], residual_sigma=1e-3)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> wide = Alignment(np.diag([-1.0, -1.0, 1.0]), [0, 0, 9], [1.2, 1, 1.2])
    >>> view = View(camera, camera.project(wide.apply(corners[4:])), ids=[4, 5, 6, 7])
    >>> posterior = shape_posterior(align(model, view), view).shapes
    >>> posterior.means.reshape(10, 3)[0].round(2).tolist()
    [-1.2, -1.0, -1.2]
    """
    if not isinstance(result.model, ShapeModel) or len(result.poses) != 1:
        what = "expected the alignment of a shape model with one view"
        raise InputError(what, where="result")
    by_shape, by_pose, residuals = _linearised(result, view, LOSSES[loss], loss_scale)
    full, triangle = np.linalg.qr(by_pose, mode="complete")
    rest = full[:, _POSE:].T
    estimate = np.concatenate([result.points_3d, result.bounds]).ravel()
    rows = rest @ by_shape
    right = rows @ estimate - rest @ residuals
    pose_volume = float(np.log(np.abs(triangle.diagonal())).sum())
    posterior = _conditioned(gaussians_of(result.model), rows, right)
    # The estimate's objective has the log determinant of the shape, linear here: a slope by the
    # keypoints, which moves the means. The box of an estimate is widened to hold what is seen.
    shapes, keypoints = posterior.shapes, result.points_3d.size
    gap = (estimate - shapes.means[result.component])[:keypoints]
    own = shapes.covariances[result.component][:keypoints, :keypoints]
    slope = np.linalg.pinv(own, hermitian=True) @ gap
    shifts = shapes.covariances[:, :, :keypoints] @ slope
    moved = Gaussians(shapes.weights, shapes.means + shifts, shapes.covariances)
    return ShapePosterior(moved, posterior.log_evidence - pose_volume)


def gaussians_of(model: ShapeModel) -> Gaussians:
    """The mixture of the stacked rows of a shape model."""
    parts = model.components
    return Gaussians(
        np.array([part.weight for part in parts]),
        np.array([part.mean.ravel() for part in parts]),
        np.array([part.covariance for part in parts]),
    )


def _linearised(
    result: Result, view: View, loss: int, loss_scale: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Whitened and weighted: derivatives by shape (2 n, d) and pose (2 n, 6), residuals (2 n,)."""
    kept = result.inliers
    ids = tuple(name for name, inlier in zip(view.keypoint_ids, kept, strict=True) if inlier)
    names = prior_of(result.model).rows_of(ids, "view.ids")
    pixels = np.require(cast(FloatArray, view.points_2d), requirements="W")
    camera = faced(view.camera, pixels)
    rays = rays_of(pixels, camera)
    weights = np.broadcast_to(whitening_of(view.sigma, rays, camera), (len(rays), 3))[kept]
    pose = turned_alignment(result.alignment, camera.lens_from_camera.T)
    points = result.points_3d[names]
    residuals, derivatives = whitened_errors(points, pose, rays[kept], weights)
    squares = (residuals**2).sum(axis=1).tolist()
    roots = np.array([loss_and_root(loss, loss_scale, square)[1] for square in squares])
    by_pose = roots[:, None, None] * derivatives
    by_point = by_pose[:, :, 3:]  # a translation moves every point alike
    by_shape = np.zeros((len(names), 2, len(result.points_3d) + len(result.bounds), 3))
    by_shape[np.arange(len(names)), :, names] = by_point @ (pose.rotation * pose.scale)
    count = 2 * len(names)
    weighted = roots[:, None] * residuals
    return by_shape.reshape(count, -1), by_pose.reshape(count, -1), weighted.ravel()


def _conditioned(prior: Gaussians, rows: FloatArray, right: FloatArray) -> ShapePosterior:
    """A mixture given ``rows @ x = right`` with noise of unit covariance."""
    logs, means, covariances = [], [], []
    for weight, mean, covariance in zip(prior.weights, prior.means, prior.covariances, strict=True):
        across = rows @ covariance
        seen = across @ rows.T + np.eye(len(right))
        gap = right - rows @ mean
        gain = np.linalg.solve(seen, across).T
        square = float(gap @ np.linalg.solve(seen, gap))
        logs.append(np.log(weight) - 0.5 * (square + np.linalg.slogdet(seen)[1]))
        means.append(mean + gain @ gap)
        covariances.append(covariance - gain @ across)
    total = float(np.logaddexp.reduce(logs))
    weights = np.exp(np.array(logs) - total)
    return ShapePosterior(Gaussians(weights, np.array(means), np.array(covariances)), total)
