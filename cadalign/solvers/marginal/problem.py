"""One view's keypoints and the Gaussian shapes that they may belong to.

The points x of a shape have a mean and a covariance S. What one view's keypoints tell about them
enters through ``w``, in which the shape is ``x = mean + S w`` and costs ``w' S w``: only the rows
of S that belong to keypoints count, and normal equations have the size of the keypoints, however
many modes the shape has.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import fast_sums, kernel


class Mixture(NamedTuple):
    """Gaussians over the same m points: means (G, m, 3), covariances (G, 3 m, 3 m).

    ``penalties`` (G,) are -2 log of their weights.
    """

    means: FloatArray
    covariances: FloatArray
    penalties: FloatArray


class Seen(NamedTuple):
    """Keypoints of a view: their ``points`` (n,), rays (n, 2), whitening (n, 3), and the loss.

    Whitening and loss are as in `cadalign.solvers.evidence.KeypointEvidence`.
    """

    points: IntArray
    rays: FloatArray
    whitening: FloatArray
    loss: int
    loss_scale: float


class GaussianTarget(NamedTuple):
    """One Gaussian at the keypoints: mean (n, 3) and covariance (3 n, 3 n)."""

    mean: FloatArray
    covariance: FloatArray


@kernel
def target_of(mixture: Mixture, component: int, seen: Seen) -> GaussianTarget:
    """A component at the keypoints."""
    n = seen.points.shape[0]
    whole = mixture.covariances[component]
    mean = np.empty((n, 3))
    covariance = np.empty((3 * n, 3 * n))
    for i in range(n):
        p = seen.points[i]
        for a in range(3):
            mean[i, a] = mixture.means[component, p, a]
            for j in range(n):
                q = seen.points[j]
                for b in range(3):
                    covariance[3 * i + a, 3 * j + b] = whole[3 * p + a, 3 * q + b]
    return GaussianTarget(mean, covariance)


@fast_sums
def shape_at(mixture: Mixture, component: int, seen: Seen, force: FloatArray) -> FloatArray:
    """All points (m, 3) of the shape that a force (n, 3) on the keypoints leads to."""
    whole = mixture.covariances[component]
    points: FloatArray = mixture.means[component].copy()
    for p in range(points.shape[0]):
        for a in range(3):
            total = 0.0
            for i in range(seen.points.shape[0]):
                first = 3 * seen.points[i]
                for b in range(3):
                    total += whole[3 * p + a, first + b] * force[i, b]
            points[p, a] += total
    return points
