"""Uncertainty of an alignment: standard deviations, and the sentences that warn about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import angle_between

WEAK_SCALE = 0.1
"""Relative standard deviation of a scale that is worth a warning."""
_WEAK_FOCAL = 0.02
_SHALLOW = 0.5  # differences of depth over the distance
WEAK_ROTATION_DEG = 10.0
WEAK_DISTANCE = 0.1  # standard deviation of the translation over its length
_THIN = 0.1  # spread along an axis over the largest that counts as nearly a plane
_END_ON_DEG = 15.0
_LIKELY = 0.1  # probability of an alternative that is worth a warning
_LEAST_PROBABILITY = 0.005  # of residuals as large as these by chance


@dataclass(frozen=True)
class Uncertainty:
    """Predicted standard deviations of an alignment.

    Parameters
    ----------
    rotation_deg : float
        Of the rotation about all axes together [degrees].
    translation : tuple of 3 float
        Along the camera's axes [model units].
    scale : tuple of 3 float
        Of the scale along the model's x, y, z, relative (0.02 is 2 %); 0 where it is known.
    focal : float
        Of the focal length, relative; 0 where it is known.
    """

    rotation_deg: float
    translation: tuple[float, float, float]
    scale: tuple[float, float, float]
    focal: float


def uncertainty_of(covariance: FloatArray) -> Uncertainty:
    """Standard deviations from a covariance (9, 9) or (10, 10)."""
    variance = np.maximum(covariance.diagonal(), 0.0)
    x, y, z, sx, sy, sz = np.sqrt(variance[3:9]).tolist()
    return Uncertainty(
        rotation_deg=float(np.degrees(np.sqrt(variance[:3].sum()))),
        translation=(x, y, z),
        scale=(sx, sy, sz),
        focal=float(np.sqrt(variance[9:].sum())),
    )


@np.errstate(all="ignore")  # lengths that overflow are of translations known well enough
def weaknesses_of_keypoints(
    points_3d: FloatArray,
    alignment: Alignment,
    std: Uncertainty,
    *,
    redundancy: int,
    doubt: str | None,
) -> tuple[str, ...]:
    """Warn about stretch and motion that the keypoints leave uncertain, with the reason.

    ``redundancy`` counts the equations minus the unknowns; ``doubt`` is a warning about an
    estimated focal length that looks well determined.
    """
    warnings = []
    if redundancy <= 0:
        warnings.append(
            f"{len(points_3d)} keypoints fit exactly whatever they are: "
            "the residuals say nothing about the quality of the fit"
        )
    if std.focal > _WEAK_FOCAL:
        why = _why_focal_is_weak(points_3d, alignment)
        warnings.append(_known_only("the focal length", percent(std.focal), why))
    if doubt is not None:
        warnings.append(doubt)
    for axis, relative in enumerate(std.scale):
        if relative > WEAK_SCALE:
            why = _why_scale_is_weak(points_3d, alignment, axis)
            warnings.append(_known_only(f"s_{'xyz'[axis]}", percent(relative), why))
    warnings += _weak_rotation(std)
    distance, spread = _distance(alignment, std)
    if spread > WEAK_DISTANCE * distance:
        direction = "xyz"[int(np.argmax(std.translation))]
        share = f" ({percent(spread / distance)} of the distance)" if distance > 0 else ""
        size = f"{max(std.translation):.2g} model units{share}"
        warnings.append(_known_only(f"the translation along the camera's {direction}", size))
    return tuple(warnings)


def weaknesses(alignment: Alignment, std: Uncertainty) -> tuple[str, ...]:
    """Warn about rotation, lengths, distance and focal length that are known badly."""
    warnings = _weak_rotation(std)
    for axis, relative in zip("xyz", std.scale, strict=True):
        if relative > WEAK_SCALE:
            warnings.append(_known_only(f"the length along {axis}", percent(relative)))
    distance, spread = _distance(alignment, std)
    if spread > WEAK_DISTANCE * distance > 0:
        warnings.append(_known_only("the distance", percent(spread / distance)))
    if std.focal > WEAK_SCALE:
        warnings.append(_known_only("the focal length", percent(std.focal)))
    return tuple(warnings)


def _known_only(what: str, to: str, why: str = "") -> str:
    return f"{what} is known only to +-{to}" + (f": {why}" if why else "")


def _weak_rotation(std: Uncertainty) -> list[str]:
    if std.rotation_deg <= WEAK_ROTATION_DEG:
        return []
    return [_known_only("the rotation", f"{std.rotation_deg:.2g} deg")]


def _distance(alignment: Alignment, std: Uncertainty) -> tuple[float, float]:
    """The distance, and the standard deviation of the translation along all axes together."""
    return float(np.linalg.norm(alignment.translation)), float(np.linalg.norm(std.translation))


def _why_focal_is_weak(points_3d: FloatArray, alignment: Alignment) -> str:
    in_camera = alignment.apply(points_3d)
    thickness = np.linalg.svd(in_camera - in_camera.mean(axis=0), compute_uv=False)
    if thickness[-1] < _THIN * thickness[0]:
        return "the keypoints lie nearly in one plane"
    if np.ptp(in_camera[:, 2]) < _SHALLOW * in_camera[:, 2].mean():
        return "the keypoints differ little in depth for their distance"
    return "the keypoints show little perspective for their noise"


def _why_scale_is_weak(points_3d: FloatArray, alignment: Alignment, axis: int) -> str:
    name = "xyz"[axis]
    spread = points_3d.std(axis=0)
    center = points_3d.mean(axis=0)
    if spread[axis] < _THIN * spread.max():
        return f"the keypoints lie nearly in the plane {name} = {center[axis]:.3g}"
    ray = alignment.apply(center[None])[0]
    cosine = abs(ray @ alignment.rotation[:, axis]) / np.linalg.norm(ray)
    if np.degrees(np.arccos(min(1.0, cosine))) < _END_ON_DEG:
        return f"the model's {name} axis is seen nearly end-on"
    thickness = np.linalg.svd(points_3d - center, compute_uv=False)
    if thickness[2] < _THIN * thickness[0]:
        return "the keypoints lie nearly in one plane"
    return "there are few keypoints for their noise"


def percent(fraction: float) -> str:
    """A share in percent, for a sentence."""
    return f"{100 * fraction:.0f} %" if fraction < 100 else "more than 10000 %"


def another_pose(
    best: Alignment, others: Sequence[Alignment], likelihoods: Sequence[float]
) -> tuple[str, ...]:
    """Warning about the likeliest of others, relative to the best, if it has a share of both."""
    if not others:
        return ()
    likeliest = int(np.argmax(likelihoods))
    share = likelihoods[likeliest] / (1 + sum(likelihoods))
    angle = angle_between(others[likeliest].rotation, best.rotation)
    if share < _LIKELY or angle < WEAK_ROTATION_DEG:
        return ()
    return (
        f"another pose, {angle:.0f} deg away, has a probability of {100 * share:.0f} %: "
        "see `alternatives`",
    )


def misfits(cost: float, redundancy: int) -> tuple[str, ...]:
    """Report residuals that are too large for their standard deviations.

    At the optimum the cost, priors included, is distributed as chi-square: every unknown with a
    prior adds one equation, every other takes one away.
    """
    from scipy.special import chdtrc  # takes longer to import than all that is compiled

    if redundancy <= 0 or chdtrc(redundancy, cost) >= _LEAST_PROBABILITY:
        return ()
    ratio = np.sqrt(cost / redundancy)
    return (
        f"the residuals are {ratio:.2g} times as large as sigma and the spread of shapes allow: "
        "a keypoint, a sigma or the model is wrong",
    )
