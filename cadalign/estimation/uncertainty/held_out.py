"""Test of the keypoints of one view of a learned shape: each against what the others predict.

The errors of held-out objects are distributed as a multivariate t: one unknown scale widens all of
an object's shape. The other keypoints tell the scale, so that a keypoint is tested by an F
distribution (Kotz and Nadarajah, "Multivariate t distributions and their applications", 2004).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import quote
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.pixels import perspective
from cadalign.shapes.tails import probability_within
from cadalign.solvers.projection import ray_derivatives

_FALSE_ALARMS = 0.005  # of all tests of a view together
_POSE = 6
_WORTH_TESTING = 1.0  # reduced chi-square


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


def keypoint_misfits(
    seen: SeenShape, cost: float, names: Sequence[object], *, tails: ShapeTails, focal: float
) -> tuple[str, ...]:
    """Warn about a keypoint that contradicts the others, or about all that do not fit together.

    ``cost`` is that of the estimate; ``focal`` [px] turns distances into pixels.
    """
    count = len(seen.rays)
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
    total = float(errors @ weight @ errors)
    worst = int(np.argmax(squares))
    freedom = tails.degrees_of_freedom
    alone, others = float(squares[worst]), None
    gaussian_or_t = ShapeTails(degrees_of_freedom=freedom)  # the errors are inflated already
    fits_without = not misfits(total - alone, redundancy - 2, gaussian_or_t)
    if freedom is not None:
        others = freedom + redundancy - 2
        # The scale of this object's shape, by the prior and by the other keypoints.
        alone *= others / (freedom - 2 + total - alone) * (others - 2) / others
    is_wrong = count * (1 - probability_within(alone, 2, others)) < _FALSE_ALARMS
    if is_wrong and fits_without:
        away = np.linalg.solve(whitening_matrices(seen.whitening)[worst], misses[worst])
        pixels = focal * float(np.linalg.norm(away))
        return (
            f"keypoint {quote(names[worst])} is {pixels:.2g} px from where the others and the "
            "learned shapes predict it: a wrong keypoint, or a part that the shapes do not have",
        )
    return misfits(total, redundancy, gaussian_or_t)


def misfits(cost: float, redundancy: int, tails: ShapeTails) -> tuple[str, ...]:
    """Report residuals that are too large for their standard deviations.

    At the optimum the cost, priors included, is distributed as chi-square: every unknown with a
    prior adds one equation, every other takes one away. Of a learned shape it is distributed as
    errors of held-out objects are, see `ShapeTails`.
    """
    if redundancy <= 0 or cost < redundancy:
        return ()
    squares = cost / tails.inflation**2
    if 1 - probability_within(squares, redundancy, tails.degrees_of_freedom) >= _FALSE_ALARMS:
        return ()
    ratio = np.sqrt(squares / redundancy)
    return (
        f"the residuals are {ratio:.2g} times as large as sigma and the spread of shapes allow: "
        "a keypoint, a sigma or the model is wrong",
    )


def _predicted(seen: SeenShape, inflation: float) -> tuple[FloatArray, FloatArray]:
    """Whitened errors (2 n,) of the mean shape, and their inverse covariance beside any pose."""
    count = len(seen.rays)
    errors, by_pose = whitened_errors(seen.points, seen.pose, seen.rays, seen.whitening)
    by_point = by_pose[:, :, 3:] @ seen.pose.rotation
    errors = errors - (by_point @ (seen.points - seen.mean)[:, :, None])[:, :, 0]
    by_shape = np.zeros((count, 2, count, 3))
    by_shape[np.arange(count), :, np.arange(count)] = by_point
    rows = by_shape.reshape(2 * count, 3 * count)
    spread = inflation**2 * (rows @ seen.covariance @ rows.T) + np.eye(2 * count)
    inverse = np.linalg.inv(spread)
    pose = by_pose.reshape(2 * count, _POSE)
    weighted = inverse @ pose
    weight = inverse - weighted @ np.linalg.solve(pose.T @ weighted, weighted.T)
    return errors.ravel(), np.asarray(weight)


def whitened_errors(
    points: FloatArray, pose: Alignment, rays: FloatArray, whitening: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened errors (n, 2) of points in a view, and their derivatives (n, 2, 6) by the pose."""
    matrices = whitening_matrices(whitening)
    errors = matrices @ (perspective(pose.apply(points)) - rays)[:, :, None]
    by_pose = matrices @ ray_derivatives(points, pose.packed)[:, :, :_POSE]
    return errors[:, :, 0], by_pose


def whitening_matrices(whitening: FloatArray) -> FloatArray:
    """Whitening (n, 3) as upper triangular matrices (n, 2, 2)."""
    matrices = np.zeros((len(whitening), 2, 2))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1] = whitening.T
    return matrices
