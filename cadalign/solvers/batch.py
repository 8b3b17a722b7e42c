"""Many problems in one compiled call; a single fit is a batch of one.

The problems' points lie one after the other: problem b has the rows ``offsets[b]`` to
``offsets[b + 1]``.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.constants import DEGENERATE, NOT_FOUND, OK, POSE_SIZE, TOO_FEW, UNKNOWNS
from cadalign.solvers.linear import MIN_POINTS, aepnp_kernel
from cadalign.solvers.objective import Objective
from cadalign.solvers.optimal import MAX_MINIMA, optimal_kernel


@kernel
def aepnp_batch(
    points: FloatArray, rays: FloatArray, offsets: IntArray
) -> tuple[FloatArray, IntArray]:
    """Solve every problem linearly; packed poses (B, 1, 15) and statuses (B,)."""
    count = offsets.shape[0] - 1
    poses = np.empty((count, 1, POSE_SIZE))
    statuses = np.empty(count, dtype=np.int64)
    for b in range(count):
        start, end = offsets[b], offsets[b + 1]
        rotation, translation, scale, statuses[b] = aepnp_kernel(points[start:end], rays[start:end])
        poses[b, 0, :9] = rotation.ravel()
        poses[b, 0, 9:12] = translation
        poses[b, 0, 12:] = scale
        if end - start < MIN_POINTS:
            statuses[b] = TOO_FEW
    return poses, statuses


@kernel
def optimal_batch(
    points: FloatArray,
    rays: FloatArray,
    whitening: FloatArray,
    offsets: IntArray,
    loss: int,
    loss_scale: FloatArray,
    prior_weight: FloatArray,
    free: FloatArray,
    min_points: int,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray]:
    """Find the optimum of every problem.

    ``loss_scale`` and ``prior_weight`` (B,) are in units of the whitening's sigma. Returns the
    minima's poses (B, MAX_MINIMA, 15) and costs (B, MAX_MINIMA), the covariance of the best
    (B, 8, 8), statuses (B,), and (B, 4) the number of minima, iterations, hypotheses, and the
    number of an undetermined unknown or -1.
    """
    count = offsets.shape[0] - 1
    poses = np.zeros((count, MAX_MINIMA, POSE_SIZE))
    costs = np.full((count, MAX_MINIMA), np.inf)
    covariances = np.zeros((count, UNKNOWNS, UNKNOWNS))
    info = np.zeros((count, 4), dtype=np.int64)
    statuses = np.zeros(count, dtype=np.int64)
    for b in range(count):
        start, end = offsets[b], offsets[b + 1]
        if end - start < min_points:
            statuses[b] = TOO_FEW
            continue
        objective = Objective(
            points[start:end],
            rays[start:end],
            whitening[start:end] if whitening.shape[0] > 1 else whitening,
            loss,
            loss_scale[b],
            prior_weight[b],
            free,
        )
        info[b, 0], info[b, 1], info[b, 2], info[b, 3] = optimal_kernel(
            objective, poses[b], costs[b], covariances[b]
        )
        if info[b, 3] >= 0:
            statuses[b] = DEGENERATE
        elif info[b, 0] == 0:
            statuses[b] = NOT_FOUND
    return poses, costs, covariances, statuses, info


@kernel
def reproject_batch(
    points: FloatArray,
    points_2d: FloatArray,
    offsets: IntArray,
    poses: FloatArray,
    cameras: FloatArray,
    statuses: IntArray,
) -> FloatArray:
    """Projected minus observed pixels (n, 2) of the first pose of every problem.

    ``poses`` (B, k, 15) are packed; ``cameras`` (1 or B, 4) holds fx, fy, cx, cy. A problem with a
    point behind the camera gets the status NOT_FOUND.
    """
    residuals = np.empty((points.shape[0], 2))
    for b in range(offsets.shape[0] - 1):
        pose = poses[b, 0]
        nearest = np.inf
        camera = cameras[b if cameras.shape[0] > 1 else 0]
        for i in range(offsets[b], offsets[b + 1]):
            x = points[i, 0] * pose[12]
            y = points[i, 1] * pose[13]
            z = points[i, 2] * pose[14]
            depth = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
            across = pose[0] * x + pose[1] * y + pose[2] * z + pose[9]
            down = pose[3] * x + pose[4] * y + pose[5] * z + pose[10]
            nearest = min(nearest, depth)
            residuals[i, 0] = across / depth * camera[0] + camera[2] - points_2d[i, 0]
            residuals[i, 1] = down / depth * camera[1] + camera[3] - points_2d[i, 1]
        if statuses[b] == OK and not nearest > 0:
            statuses[b] = NOT_FOUND
    return residuals
