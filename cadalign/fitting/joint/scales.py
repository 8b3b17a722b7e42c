"""Priors on an object's scales, with and without knowledge of its size."""

from __future__ import annotations

import numpy as np

from cadalign.fitting.joint.prior import ShapePrior
from cadalign.solvers.joint.evidence import ScalePriors

_COMMON_SCALE_SIGMA = 3.0  # of the log of a size that other evidence determines
_SAME_SCALE_SIGMA = 1e-4
_PROPORTION_SIGMA = 3.0  # of free log scales about their mean, lest an unseen axis collapses


def scale_priors(prior: ShapePrior, metric: bool) -> ScalePriors:
    """Free the size where it is told; what was held to x is then held to the common scale."""
    if not metric:
        return prior.scales
    if prior.scales.free.sum() == 2 and not prior.scales.precision.any():
        return ScalePriors(np.ones(3), (np.eye(3) - 1 / 3) / _PROPORTION_SIGMA**2)
    held = prior.scales.free == 0
    weights = np.where(held, 1 / _SAME_SCALE_SIGMA**2, prior.scales.precision.diagonal())
    common = np.tile(held / held.sum(), (3, 1))
    from_common = np.eye(3) - common
    tied = from_common.T @ (weights[:, None] * from_common)
    return ScalePriors(np.ones(3), tied + common.T @ common / (3 * _COMMON_SCALE_SIGMA**2))


def has_scale_prior(scales: ScalePriors) -> bool:
    """True where a prior ties the scales together more than any plausible proportions do."""
    return bool((scales.precision > 2 / _PROPORTION_SIGMA**2).any())
