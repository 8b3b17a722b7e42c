"""Learned shapes in one view: the posterior of the whole shape, and the test of each keypoint.

The reprojection errors are linear in shape and pose about the estimate of `align`. Whitened and
projected to what no change of the pose explains, they read ``A x = b + noise`` of unit covariance,
with the stacked rows x of the shape: each Gaussian of the category is conditioned on that in closed
form, and its weight grows with the probability that it gave to b.

Each keypoint is tested against what the others predict. The errors of held-out objects are
distributed as a multivariate t: one unknown scale widens all of an object's shape. The other
keypoints determine the scale, so that a keypoint is tested by an F distribution (Kotz and
Nadarajah, "Multivariate t distributions and their applications", 2004).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError, quote
from cadalign.estimation.estimates import widened_boxes
from cadalign.estimation.options import LOSSES
from cadalign.estimation.prior import prior_of
from cadalign.estimation.problems import rays_of, whitening_of
from cadalign.estimation.uncertainty.residuals import loss_slopes, whitening_matrices
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import faced, turned_alignment
from cadalign.geometry.pixels import perspective
from cadalign.geometry.rotations import by_rotation
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import probability_within
from cadalign.solvers.marginal.problem import Mixture, Seen, coordinates_of, shape_at
from cadalign.solvers.projection import ray_derivatives

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View

_POSE = 6
_FALSE_ALARMS = 0.005  # of all tests of a view together
_WORTH_TESTING = 1.0  # reduced chi-square


class ShapePosterior(NamedTuple):
    """Knowledge of an object's shape from one image and a shape model.

    ``shapes`` is a mixture over the stacked rows: x, y, z of each keypoint of the shape model, then
    of the least and the greatest corner of its linear box [model units]. ``log_evidence`` is the
    log of the probability density of the image's whitened keypoints, up to a constant, given that
    the object is of the category: it compares shape models that have all of them.
    """

    shapes: Gaussians
    log_evidence: float


class ShapeTails(NamedTuple):
    """Distribution of held-out objects' errors about a learned shape."""

    inflation: float = 1.0  # factor on the standard deviations of the shape
    degrees_of_freedom: float | None = None  # tails; None for Gaussian ones


class SeenShape(NamedTuple):
    """Keypoints of one view, and the learned shape's Gaussian about them."""

    points: FloatArray  # (n, 3) of the estimate [model units]
    mean: FloatArray  # (n, 3)
    covariance: FloatArray  # (3 n, 3 n) about the mean
    pose: Alignment  # the estimate, without a stretch
    rays: FloatArray  # (n, 2) observed, normalised
    whitening: FloatArray  # (n, 3), as of `cadalign.solvers.marginal.problem.Seen`


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

    >>> from cadalign import Alignment, Camera, View, align
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
    shapes, log_evidence = _conditioned(gaussians_of(result.model), rows, right)
    # The estimate's objective has the log determinant of the shape, linear here: a slope by the
    # keypoints, which moves the means. The box of an estimate is widened to hold what is seen.
    keypoints = result.points_3d.size
    gap = (estimate - shapes.means[result.component])[:keypoints]
    own = shapes.covariances[result.component][:keypoints, :keypoints]
    slope = np.linalg.pinv(own, hermitian=True) @ gap
    shifts = shapes.covariances[:, :, :keypoints] @ slope
    moved = Gaussians(shapes.weights, shapes.means + shifts, shapes.covariances)
    return ShapePosterior(moved, log_evidence - pose_volume)


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
    pixels = np.require(view.pixels, requirements="W")
    camera = faced(view.camera, pixels)
    rays = rays_of(pixels, camera)
    weights = np.broadcast_to(whitening_of(view.sigma, rays, camera), (len(rays), 3))[kept]
    pose = turned_alignment(result.alignment, camera.lens_from_camera.T)
    points = result.points_3d[names]
    residuals, derivatives = whitened_errors(points, pose, rays[kept], weights)
    roots = np.sqrt(loss_slopes((residuals**2).sum(axis=1), loss, loss_scale)[0])
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


def whitened_errors(
    points: FloatArray, pose: Alignment, rays: FloatArray, whitening: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened errors (n, 2) of points in a view, and their derivatives (n, 2, 6) by the pose."""
    matrices = whitening_matrices(whitening)
    errors = matrices @ (perspective(pose.apply(points)) - rays)[:, :, None]
    by_pose = matrices @ ray_derivatives(points, pose.packed)[:, :, :_POSE]
    return errors[:, :, 0], by_pose


def keypoint_misfits(
    seen: SeenShape, cost: float, names: Sequence[object], *, tails: ShapeTails, focal: float
) -> Warnings:
    """Warn about a keypoint that contradicts the others, or about all that do not fit together.

    ``cost`` is that of the estimate; ``focal`` [px] turns distances into pixels.
    """
    count, freedom = len(seen.rays), tails.degrees_of_freedom
    redundancy = 2 * count - _POSE
    if redundancy <= 0 or cost < _WORTH_TESTING * redundancy:
        return ()
    errors, weight = _predicted(seen, tails.inflation)
    forces = (weight @ errors).reshape(count, 2)
    blocks = weight.reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]
    if np.linalg.eigvalsh(blocks).min() <= 0:  # nothing predicts the keypoint
        return ()
    misses = np.linalg.solve(blocks, forces[:, :, None])[:, :, 0]
    squares = (misses * forces).sum(axis=1)
    total, worst = float(errors @ weight @ errors), int(np.argmax(squares))
    alone, others = float(squares[worst]), None
    inflated = ShapeTails(degrees_of_freedom=freedom)  # as the errors are
    fits_without = not misfits(total - alone, redundancy - 2, inflated)
    if freedom is not None:
        others = freedom + redundancy - 2
        # The scale of this object's shape, by the prior and by the other keypoints.
        alone *= others / (freedom - 2 + total - alone) * (others - 2) / others
    is_wrong = count * (1 - probability_within(alone, 2, others)) < _FALSE_ALARMS
    if is_wrong and fits_without:
        away = np.linalg.solve(whitening_matrices(seen.whitening)[worst], misses[worst])
        pixels = focal * float(np.linalg.norm(away))
        text = (
            f"keypoint {quote(names[worst])} is {pixels:.2g} px from where the others and the "
            "learned shapes predict it: a wrong keypoint, or a part that the shapes do not have"
        )
        return (EstimateWarning("outlier", text, 0, (worst,)),)
    return misfits(total, redundancy, inflated)


def misfits(cost: float, redundancy: int, tails: ShapeTails) -> Warnings:
    """Report residuals that are too large for their standard deviations.

    At the optimum the cost, priors included, is distributed as chi-square: every unknown with a
    prior adds one equation, every other takes one away. For a learned shape it is distributed as
    errors of held-out objects are, see `ShapeTails`.
    """
    if redundancy <= 0 or cost < redundancy:
        return ()
    squares = cost / tails.inflation**2
    if 1 - probability_within(squares, redundancy, tails.degrees_of_freedom) >= _FALSE_ALARMS:
        return ()
    ratio = np.sqrt(squares / redundancy)
    text = (
        f"the residuals are {ratio:.2g} times as large as sigma and the spread of shapes allow: "
        "a keypoint, a sigma or the model is wrong"
    )
    return (EstimateWarning("misfit", text),)


def _predicted(seen: SeenShape, inflation: float) -> tuple[FloatArray, FloatArray]:
    """Whitened errors (2 n,) of the mean shape, and their inverse covariance beside any pose."""
    count = len(seen.rays)
    errors, by_pose = whitened_errors(seen.points, seen.pose, seen.rays, seen.whitening)
    by_point = by_pose[:, :, 3:] @ seen.pose.rotation
    errors = errors - (by_point @ (seen.points - seen.mean)[:, :, None])[:, :, 0]
    rows = _block_diagonal(by_point)
    spread = inflation**2 * (rows @ seen.covariance @ rows.T) + np.eye(2 * count)
    inverse = np.linalg.inv(spread)
    pose = by_pose.reshape(2 * count, _POSE)
    weighted = inverse @ pose
    weight = inverse - weighted @ np.linalg.solve(pose.T @ weighted, weighted.T)
    return errors.ravel(), np.asarray(weight)


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """The matrices (..., 2 n, 3 n) with blocks (..., n, 2, 3) along their diagonals."""
    *several, count, _, _ = blocks.shape
    rows = np.zeros((*several, count, 2, count, 3))
    np.einsum("...iaib->...iab", rows)[:] = blocks
    return rows.reshape(*several, 2 * count, 3 * count)


class SinglePosterior(NamedTuple):
    """Pose, points (m, 3) and the box's ``lengths`` (3,) of an estimate, and covariances.

    ``covariance`` (9, 9) is that of the pose and the log lengths of the box, whose corners are the
    last two points; ``of_points`` (m, 3, 3) are those of the points in the model's frame, and
    ``of_seen`` (m, 3, 3) in the camera's, where they include the pose.
    """

    pose: Alignment
    points: FloatArray
    lengths: FloatArray
    covariance: FloatArray
    of_points: FloatArray
    of_seen: FloatArray


def single_posteriors(
    mixture: Mixture, components: IntArray, seen: Seen, states: FloatArray, inflation: float
) -> list[SinglePosterior]:
    """The posterior at each state (K, D) of a component (K,), all of them at once.

    The deviations of the prior are widened by the ``inflation``. The box holds the keypoints that
    are seen. Covariances are infinite where the pose is not determined.
    """
    size, count, m = len(states), len(seen.points), mixture.means.shape[1]
    rotations = states[:, :9].reshape(-1, 3, 3)
    poses = [
        Alignment(row[:9].reshape(3, 3), row[9:12], np.ones(3), is_valid=True) for row in states
    ]
    given = zip(components.tolist(), states, strict=True)
    points = np.array([shape_at(mixture, component, seen, state) for component, state in given])
    boxes = widened_boxes(points, seen.points)
    views = [
        whitened_errors(each[seen.points], pose, seen.rays, seen.whitening)
        for each, pose in zip(points, poses, strict=True)
    ]
    errors, by_pose = np.array([own for own, _ in views]), np.array([slopes for _, slopes in views])
    weights, _ = loss_slopes((errors**2).sum(axis=-1), seen.loss, seen.loss_scale)
    by_pose *= np.sqrt(weights)[..., None, None]
    rows = _block_diagonal(by_pose[..., 3:] @ rotations[:, None])
    jacobian = by_pose.reshape(size, 2 * count, _POSE)
    prior = inflation**2 * mixture.covariances[components]
    columns = coordinates_of(seen)
    told = prior[:, :, columns] @ rows.swapaxes(1, 2)  # covariance of points with residuals
    # Behind the points, the difference of the box's corners.
    told = np.concatenate([told, told[:, -3:] - told[:, -6:-3]], axis=1)
    blocks = prior.reshape(size, m, 3, m, 3)
    corners = blocks[:, -2:, :, -2:]
    across = corners[:, 1, :, 0]
    difference = corners[:, 1, :, 1] + corners[:, 0, :, 0] - across - across.swapaxes(1, 2)
    own = np.einsum("kiaib->kiab", blocks)
    own = np.concatenate([own, difference[:, None]], axis=1)
    both = np.concatenate([told.swapaxes(1, 2), jacobian], axis=2)
    solved = np.linalg.solve(rows @ told[:, columns] + np.eye(2 * count), both).swapaxes(1, 2)
    solved, weight = solved[:, :-_POSE], solved[:, -_POSE:]
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(weight @ jacobian))
    except np.linalg.LinAlgError:
        if size > 1:
            each = [(components[k : k + 1], seen, states[k : k + 1]) for k in range(size)]
            return [single_posteriors(mixture, *one, inflation)[0] for one in each]
        unknown = np.full((m, 3, 3), np.inf)
        infinite = np.full((9, 9), np.inf), unknown, unknown
        return [SinglePosterior(poses[0], boxes[0], np.ptp(boxes[0, -2:], axis=0), *infinite)]
    of_pose = inverse.swapaxes(1, 2) @ inverse
    by_steps = (-solved @ jacobian).reshape(size, m + 1, 3, _POSE)
    shape = size, m + 1, 3, 2 * count
    left = own - solved.reshape(shape) @ told.reshape(shape).swapaxes(2, 3)
    whole = left + by_steps @ of_pose[:, None] @ by_steps.swapaxes(2, 3)
    turns = rotations[:, None]
    in_camera = turns @ by_steps[:, :m]
    in_camera[..., :3] += by_rotation(points @ rotations.swapaxes(1, 2))
    in_camera[..., 3:] += np.eye(3)
    of_seen = turns @ left[:, :m] @ turns.swapaxes(2, 3)
    of_seen += in_camera @ of_pose[:, None] @ in_camera.swapaxes(2, 3)
    extent = points[:, -1] - points[:, -2]
    relative = np.where(extent > 0, 1.0 / np.where(extent > 0, extent, 1.0), 0.0)
    logs = np.concatenate(
        [np.broadcast_to(np.eye(_POSE), of_pose.shape), relative[..., None] * by_steps[:, m]],
        axis=1,
    )
    covariances = logs @ of_pose @ logs.swapaxes(1, 2)
    covariances[:, _POSE:, _POSE:] += relative[:, :, None] * relative[:, None] * left[:, m]
    lengths = boxes[:, -1] - boxes[:, -2]
    found = poses, boxes, lengths, covariances, whole[:, :m], of_seen
    return [SinglePosterior(*each) for each in zip(*found, strict=True)]
