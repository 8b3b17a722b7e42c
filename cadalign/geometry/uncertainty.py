"""Standard deviations of an alignment, and the one rule of what is uncertain."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment

UNCERTAIN = 0.25
"""Relative standard deviation beyond which a stretch, a distance or a focal length is uncertain."""
UNCERTAIN_ROTATION_DEG = 30.0
NOT_DETERMINED = 1.0
"""Relative standard deviation beyond which a number makes no sense."""
NOT_DETERMINED_ROTATION_DEG = 60.0
_THIN = 0.1  # spread along an axis over the largest that counts as nearly a plane
_END_ON = math.cos(math.radians(15.0))
_ROUNDING = 1e-12  # relative standard deviation below which a length is known


@dataclass(frozen=True)
class Uncertainty:
    """Predicted standard deviations of an alignment."""

    rotation_deg: float
    """Rotation [degrees]: the root of the sum of the variances about three axes."""
    translation: tuple[float, float, float]
    """Along the camera's axes [model units]."""
    scale: tuple[float, float, float]
    """Scale along the model's x, y, z, relative (0.02 is 2 %); 0 where it is known."""
    focal: float
    """Focal length, relative; 0 where it is known."""


def uncertainty_of(covariance: FloatArray) -> Uncertainty:
    """Standard deviations from a covariance (9, 9) or (10, 10)."""
    variance = np.maximum(covariance.diagonal(), 0.0)
    variance[6:9][variance[6:9] < _ROUNDING**2] = 0.0
    x, y, z, sx, sy, sz = np.sqrt(variance[3:9]).tolist()
    return Uncertainty(
        rotation_deg=float(np.degrees(np.sqrt(variance[:3].sum()))),
        translation=(x, y, z),
        scale=(sx, sy, sz),
        focal=float(np.sqrt(variance[9:].sum())),
    )


def distance_deviation(alignment: Alignment, covariance: FloatArray) -> float:
    """Standard deviation of the distance from the camera to the model's origin, relative to it."""
    translation = alignment.translation
    square = float(translation @ translation)
    if not square > 0:
        return math.inf
    along = translation @ covariance[3:6, 3:6] @ translation
    return math.sqrt(max(float(along), 0.0)) / square


def uncertain_of(alignment: Alignment, covariance: FloatArray) -> tuple[str, ...]:
    """Names of what is uncertain: "s_x", "s_y", "s_z", "distance", "focal length", "rotation".

    Examples
    --------
    >>> pose = Alignment(np.eye(3), [0, 0, 5.0], [1, 1, 1])
    >>> uncertain_of(pose, np.diag([1e-4] * 3 + [0, 0, 4.0] + [0, 0.01, 0.09]))
    ('s_z', 'distance')
    """
    std = uncertainty_of(covariance)
    relative = dict(zip(("s_x", "s_y", "s_z"), std.scale, strict=True))
    relative |= {"distance": distance_deviation(alignment, covariance), "focal length": std.focal}
    found = [name for name, deviation in relative.items() if deviation > UNCERTAIN]
    return (*found, *(["rotation"] if std.rotation_deg > UNCERTAIN_ROTATION_DEG else []))


def deviation_text(relative: float) -> str:
    """A relative standard deviation as it follows a number.

    Examples
    --------
    >>> deviation_text(0.02), deviation_text(120.0), deviation_text(0)
    (' +- 2 %', ' (not determined)', '')
    """
    if relative > NOT_DETERMINED:
        return " (not determined)"
    return f" +- {100 * relative:.2g} %" if relative else ""


def why_open(name: str, points_3d: FloatArray, alignment: Alignment) -> str:
    """The reason for an uncertain stretch of keypoints (n, 3), in brackets; empty for others."""
    axis = {"s_x": 0, "s_y": 1, "s_z": 2}.get(name)
    if axis is None or not len(points_3d):
        return ""
    spread, center, letter = points_3d.std(axis=0), points_3d.mean(axis=0), "xyz"[axis]
    if spread[axis] < _THIN * spread.max():
        return f" (the keypoints lie nearly in the plane {letter} = {center[axis]:.3g})"
    ray = alignment.apply(center[None])[0]
    cosine = abs(ray @ alignment.rotation[:, axis]) / np.linalg.norm(ray)
    return f" (the model's {letter} axis is seen nearly end-on)" if cosine > _END_ON else ""
