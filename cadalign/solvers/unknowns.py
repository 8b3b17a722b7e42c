"""Unknowns of an alignment: order, packing and steps.

A pose is packed into 15 numbers: rotation row by row (9), translation (3), scale (3). The unknowns
are, in this order, a rotation vector applied in the camera frame (3), translation (3), log s_y and
log s_z.
"""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import inline, kernel
from cadalign.solvers.linalg import polish_rotation

_LARGEST_LOG_STEP = 2.0
_ROTATION_ERROR = 1e-10


@kernel
def pack_pose(
    rotation: FloatArray, translation: FloatArray, scale: FloatArray, pose: FloatArray
) -> None:
    """Write rotation (3, 3), translation (3,) and scale (3,) into ``pose`` (15,)."""
    for i in range(3):
        for j in range(3):
            pose[3 * i + j] = rotation[i, j]
        pose[9 + i] = translation[i]
        pose[12 + i] = scale[i]


@inline
def move_rigid(pose: FloatArray, step: FloatArray, moved: FloatArray) -> None:
    """Write rotation and translation after a step of their 6 unknowns."""
    angle2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    angle = np.sqrt(angle2)
    if angle > 1e-4:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle2
    else:
        a = 1.0 - angle2 / 6.0
        b = 0.5 - angle2 / 24.0
    x, y, z = step[0], step[1], step[2]
    for c in range(3):
        p, q, r = pose[c], pose[3 + c], pose[6 + c]
        # Rodrigues: v + a (w x v) + b (w x (w x v))
        dot = x * p + y * q + z * r
        moved[c] = p + a * (y * r - z * q) + b * (x * dot - p * angle2)
        moved[3 + c] = q + a * (z * p - x * r) + b * (y * dot - q * angle2)
        moved[6 + c] = r + a * (x * q - y * p) + b * (z * dot - r * angle2)
    for c in range(3):
        moved[9 + c] = pose[9 + c] + step[3 + c]


@kernel
def move_pose(pose: FloatArray, step: FloatArray, moved: FloatArray) -> None:
    """Write the pose after a step of the 8 unknowns into ``moved``."""
    move_rigid(pose, step, moved)
    moved[12] = pose[12]
    for k in range(2):
        log_step = min(max(step[6 + k], -_LARGEST_LOG_STEP), _LARGEST_LOG_STEP)
        moved[13 + k] = pose[13 + k] * np.exp(log_step)


@kernel
def uncenter(pose: FloatArray, center: FloatArray, unit: float) -> None:
    """Convert the pose of points (x - center) / unit to the pose of points x, in place."""
    for c in range(3):
        pose[9 + c] *= unit
        for j in range(3):
            pose[9 + c] -= pose[3 * c + j] * pose[12 + j] * center[j]


@kernel
def orthonormalize(pose: FloatArray) -> None:
    """Remove accumulated rounding errors from the rotation, in place."""
    rotation = pose[:9].reshape(3, 3)
    polish_rotation(rotation, rotation)


@kernel
def is_pose(pose: FloatArray) -> bool:
    """True if all numbers are finite, the scales positive, and the rotation orthogonal."""
    error = 0.0
    for i in range(3):
        for j in range(3):
            product = -1.0 if i == j else 0.0
            for k in range(3):
                product += pose[3 * i + k] * pose[3 * j + k]
            error = max(error, abs(product)) if product == product else np.inf
        error += 0.0 * (pose[9 + i] + pose[12 + i])
    return error < _ROTATION_ERROR and min(pose[12], pose[13], pose[14]) > 0.0
