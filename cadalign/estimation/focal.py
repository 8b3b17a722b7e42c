"""Search range and priors of an unknown focal length."""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.camera import Camera
from cadalign.io.focal import LONGEST, SHORTEST, FocalPrior

_GRID = (0.15, 0.22, 0.3, 0.4, 0.55, 0.72, 0.95, 1.25, 1.65, 2.3, 3.3, 5.0, 10.0, 30.0)

USUAL: Final = "usual"
"""In the place of a prior: that of usual lenses, `FocalPrior.of_usual_lenses`."""
_CONTRADICTING_SIGMAS = 3.0


PriorOption = FocalPrior | Literal["usual"] | None
"""Prior on an unknown focal length: one's own, that of usual lenses, or none."""


def prior_of_camera(prior: PriorOption, camera: Camera) -> FocalPrior | None:
    """The prior on the focal length of a camera."""
    if prior == USUAL:
        return FocalPrior.of_usual_lenses(camera.width, camera.height)
    assert not isinstance(prior, str)
    return prior


def check_prior(prior: object, *, focal: str) -> None:
    """Refuse what is no prior, and one on a known focal length."""
    if prior is None or (isinstance(prior, str) and prior == USUAL):
        return
    if not isinstance(prior, FocalPrior):
        what = f"expected a cadalign.FocalPrior, 'usual' or None, got {type(prior).__name__}"
        raise InputError(what, where="focal_prior")
    if focal != "estimate":
        raise InputError(
            "given for a known focal length",
            where="focal_prior",
            fix='give focal="estimate" with it',
        )


def log_focal_range(
    camera: Camera, prior: PriorOption, unit: float = 1.0
) -> tuple[float, float, float, float]:
    """Bounds of a log focal length, over ``unit`` [px], and its prior's mean and weight."""
    prior = prior_of_camera(prior, camera)
    side = max(camera.width, camera.height) / unit
    low, high = math.log(SHORTEST * side), math.log(LONGEST * side)
    if prior is None:
        return low, high, 0.0, 0.0
    mean = math.log(prior.focal / unit)
    return min(low, mean), max(high, mean), mean, prior.relative_sigma**-2


def focal_grid(camera: Camera, prior: PriorOption) -> FloatArray:
    """Focal lengths from which the search starts [px]; with a prior those near it, and it."""
    prior = prior_of_camera(prior, camera)
    grid = np.array(_GRID) * max(camera.width, camera.height)
    if prior is None:
        return grid
    near = np.abs(np.log(grid / prior.focal)) < max(4 * prior.relative_sigma, 0.5)
    return np.sort(np.append(grid[near], prior.focal))


def focal_doubt(camera: Camera, prior: PriorOption) -> EstimateWarning | None:
    """Warning about a camera whose estimated focal length contradicts its prior, or None."""
    prior = prior_of_camera(prior, camera)
    if prior is None:
        return None
    if abs(math.log(camera.fx / prior.focal)) <= _CONTRADICTING_SIGMAS * prior.relative_sigma:
        return None
    return EstimateWarning(
        "focal",
        f"the keypoints contradict the focal length's prior: {camera.fx:.4g} px instead of {prior}",
    )
