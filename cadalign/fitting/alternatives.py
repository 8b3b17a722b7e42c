"""The minima of a fit beside the best one that explain the keypoints nearly as well."""

from __future__ import annotations

import numpy as np

from cadalign.fitting.options import FitOptions
from cadalign.fitting.problems import Problems
from cadalign.fitting.result import Alternative
from cadalign.fitting.solutions import Solutions
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

LEAST_LIKELIHOOD = 1e-3
"""Relative likelihood above which another minimum is reported as an alternative."""


def camera_of(problems: Problems, solutions: Solutions, minimum: int) -> Camera:
    """The camera that goes with a minimum of the only problem."""
    camera = problems.cameras[0]
    return camera if solutions.focals is None else camera.with_focal(solutions.focals[0, minimum])


def alternatives_of(
    problems: Problems, solutions: Solutions, minima: int, options: FitOptions
) -> tuple[Alternative, ...]:
    """The other minima that are likely enough."""
    costs = solutions.costs[0, :minima]
    if options.sigma is None:  # the likelihood at the sigma that is best for each minimum
        # Costs are in units of sigma^2; below 1 they are those of exact fits.
        ratios = (max(costs[0], 1.0) / np.maximum(costs, 1.0)) ** len(problems.points_3d)
    else:
        ratios = np.exp(np.minimum(0.0, costs[0] - costs) / 2)
    return tuple(
        Alternative(
            Alignment.from_packed(solutions.poses[0, k]),
            float(ratios[k]),
            camera_of(problems, solutions, k),
        )
        for k in range(1, minima)
        if ratios[k] >= LEAST_LIKELIHOOD and np.isfinite(solutions.poses[0, k]).all()
    )
