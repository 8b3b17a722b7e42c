"""Draws from the posterior of an alignment: their deviations and log densities.

The posterior is nearly Gaussian in these 10 coordinates, all relative to the estimate: rotation
vector (3), the centroid's direction (u, v) and log depth (3), log scales (3), log focal length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.solvers.projection import project_point, scalars_of
from cadalign.solvers.unknowns import move_rigid

COORDINATES = 10
_MOST_LOG_RATIO = 3.0  # largest log change of distance, scales and focal length: the priors' bound


class CentredAlignment(NamedTuple):
    """An alignment of keypoints, relative to their centroid."""

    pose: FloatArray  # (15,) packed; the translation is the centroid in the camera
    center: FloatArray  # (3,) centroid of the keypoints in the model
    translation: FloatArray  # (3,) of the alignment itself


class WhitenedPixels(NamedTuple):
    """Whitened pixels relative to the principal point, linear in rays: ``fixed + slopes @ ray``."""

    points: FloatArray  # (n, 3) about their centroid
    slopes: FloatArray  # (n, 2, 2)
    fixed: FloatArray  # (n, 2)
    seen: FloatArray  # (n, 2), observed


class LogPriors(NamedTuple):
    """Priors on log scales (flat within a width) and on the log change of a focal length."""

    scale_weight: float
    scale_width: float
    focal_weight: float
    focal_mean: float


@kernel
def weigh_draws(
    centred: CentredAlignment, keypoints: WhitenedPixels, priors: LogPriors, steps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Deviations (k, 10), costs (k,) and log densities (k,) at coordinates (k, 10).

    Deviations are in the unknowns of a result's covariance. Costs are infinite behind the camera.
    Densities are relative to uniformly distributed rotations.
    """
    count = len(steps)
    deviations, costs, logs = steps.copy(), np.empty(count), np.empty(count)
    moved, rigid = np.empty(15), np.zeros(6)
    for k in range(count):
        step, deviation = steps[k], deviations[k]
        rigid[:3] = step[:3]
        _move(centred.pose, step, rigid, moved)
        for i in range(3):
            turned = 0.0
            for j in range(3):
                turned += moved[3 * i + j] * moved[12 + j] * centred.center[j]
            deviation[3 + i] = moved[9 + i] - turned - centred.translation[i]
        costs[k] = _residual_cost(keypoints, moved, np.exp(step[9])) + _prior_cost(
            priors, moved, step[9]
        )
        angle = np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
        within = angle < np.pi
        for j in range(5, COORDINATES):
            within = within and abs(step[j]) <= _MOST_LOG_RATIO
        logs[k] = -0.5 * costs[k] if within else -np.inf
        if within and angle > 0.0:  # density of uniform rotations in rotation vectors
            logs[k] += 2.0 * np.log(np.sin(0.5 * angle) / (0.5 * angle))
    return deviations, costs, logs


@kernel
def _move(pose: FloatArray, step: FloatArray, rigid: FloatArray, moved: FloatArray) -> None:
    move_rigid(pose, rigid, moved)
    depth = pose[11] * np.exp(step[5])
    for i in range(2):
        moved[9 + i] = (pose[9 + i] / pose[11] + step[3 + i]) * depth
    moved[11] = depth
    for j in range(3):
        moved[12 + j] = pose[12 + j] * np.exp(step[6 + j])


@kernel
def _residual_cost(keypoints: WhitenedPixels, pose: FloatArray, enlarged: float) -> float:
    scalars, total = scalars_of(pose), 0.0
    for i in range(len(keypoints.points)):
        point = keypoints.points[i]
        u, v, depth = project_point(scalars, (point[0], point[1], point[2]))
        if not depth > 0.0:
            return np.inf
        for c in range(2):
            slope = keypoints.slopes[i, c]
            pixel = enlarged * (keypoints.fixed[i, c] + slope[0] * u + slope[1] * v)
            residual = pixel - keypoints.seen[i, c]
            total += residual * residual
    return total


@kernel
def _prior_cost(priors: LogPriors, pose: FloatArray, log_focal: float) -> float:
    total = priors.focal_weight * (log_focal - priors.focal_mean) ** 2
    for j in range(12, 15):
        excess = max(abs(np.log(pose[j])) - priors.scale_width, 0.0)
        total += priors.scale_weight * excess * excess
    return total
