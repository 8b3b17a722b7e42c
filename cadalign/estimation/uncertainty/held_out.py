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
from cadalign.geometry.projection import perspective
from cadalign.shapes.tails import probability_within
from cadalign.solvers.projection import ray_derivatives

_FALSE_ALARMS = 0.005  # of all tests of a view together
_POSE = 6
_WORTH_TESTING = 1.0  # reduced chi-square


class ShapeTails(NamedTuple):
    """Distribution of held-out objects' errors about a learned shape.

    Parameters
    ----------
    inflation : float
        Factor on the standard deviations of the shape.
    degrees_of_freedom : float, optional
        Tails; None for Gaussian ones.
    """

    inflation: float = 1.0
    degrees_of_freedom: float | None = None


class SeenShape(NamedTuple):
    """Keypoints of one view, and the learned shape's Gaussian about them.

    Parameters
    ----------
    points : (n, 3) float
        The keypoints of the estimate [model units].
    mean : (n, 3) float
    covariance : (3 n, 3 n) float
        Covariance of the keypoints about the mean.
    pose : Alignment
        The estimate, without a stretch.
    rays : (n, 2) float
        The observed keypoints, normalised.
    whitening : (n, 3) float
        As of `cadalign.solvers.marginal.problem.Seen`.
    """

    points: FloatArray
    mean: FloatArray
    covariance: FloatArray
    pose: Alignment
    rays: FloatArray
    whitening: FloatArray


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
    rest = misfits(total - alone, redundancy - 2, degrees_of_freedom=freedom)
    if freedom is not None:
        others = freedom + redundancy - 2
        # The scale of this object's shape, by the prior and by the other keypoints.
        alone *= others / (freedom - 2 + total - alone) * (others - 2) / others
    is_wrong = count * (1 - probability_within(alone, 2, others)) < _FALSE_ALARMS
    if is_wrong and not rest:  # the others fit together
        away = np.linalg.solve(_whiteners(seen)[worst], misses[worst])
        pixels = focal * float(np.linalg.norm(away))
        return (
            f"keypoint {quote(names[worst])} is {pixels:.2g} px from where the others and the "
            "learned shapes predict it: a wrong keypoint, or a part that the shapes do not have",
        )
    return misfits(total, redundancy, degrees_of_freedom=freedom)


def misfits(
    cost: float,
    redundancy: int,
    *,
    inflation: float = 1.0,
    degrees_of_freedom: float | None = None,
) -> tuple[str, ...]:
    """Report residuals that are too large for their standard deviations.

    At the optimum the cost, priors included, is distributed as chi-square: every unknown with a
    prior adds one equation, every other takes one away. Of a learned shape it is distributed as
    errors of held-out objects are: wider by ``inflation`` and with the tails of so many
    ``degrees_of_freedom``.
    """
    if redundancy <= 0 or cost < redundancy:
        return ()
    squares = cost / inflation**2
    if 1 - probability_within(squares, redundancy, degrees_of_freedom) >= _FALSE_ALARMS:
        return ()
    ratio = np.sqrt(squares / redundancy)
    return (
        f"the residuals are {ratio:.2g} times as large as sigma and the spread of shapes allow: "
        "a keypoint, a sigma or the model is wrong",
    )


def _predicted(seen: SeenShape, inflation: float) -> tuple[FloatArray, FloatArray]:
    """Whitened errors (2 n,) of the mean shape, and their inverse covariance beside any pose."""
    count = len(seen.rays)
    whiteners = _whiteners(seen)
    errors = whiteners @ (perspective(seen.pose.apply(seen.points)) - seen.rays)[:, :, None]
    by_pose = whiteners @ ray_derivatives(seen.points, seen.pose.packed)[:, :, :_POSE]
    by_point = by_pose[:, :, 3:] @ seen.pose.rotation
    errors = errors[:, :, 0] - (by_point @ (seen.points - seen.mean)[:, :, None])[:, :, 0]
    by_shape = np.zeros((count, 2, count, 3))
    by_shape[np.arange(count), :, np.arange(count)] = by_point
    rows = by_shape.reshape(2 * count, 3 * count)
    spread = inflation**2 * (rows @ seen.covariance @ rows.T) + np.eye(2 * count)
    inverse = np.linalg.inv(spread)
    pose = by_pose.reshape(2 * count, _POSE)
    weighted = inverse @ pose
    weight = inverse - weighted @ np.linalg.solve(pose.T @ weighted, weighted.T)
    return errors.ravel(), np.asarray(weight)


def _whiteners(seen: SeenShape) -> FloatArray:
    """The whitening as matrices (n, 2, 2)."""
    whiteners = np.zeros((len(seen.whitening), 2, 2))
    whiteners[:, 0, 0], whiteners[:, 0, 1], whiteners[:, 1, 1] = seen.whitening.T
    return whiteners
