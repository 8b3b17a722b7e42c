"""Residuals: losses, distributions of their squares, support by chance, summaries."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import NoConsensusError
from cadalign.estimation.result_parts import EvidenceSummary
from cadalign.geometry.camera import Camera
from cadalign.shapes.parts import probability_within
from cadalign.solvers.constants import CAUCHY, HUBER
from cadalign.solvers.joint.evidence import (
    Evidence,
    State,
    depths_along_axes,
    distances_of,
    kept_rows,
    points_of,
    seen_in_cameras,
)
from cadalign.solvers.minimal import MAX_SOLUTIONS

SOLUTIONS_OF_FOUR = 2.3
"""Mean number of valid alignments to 4 points."""
LEAST_ERROR = 0.1
"""Least error of a keypoint [px]."""
_CHANCE_STRETCH = 3.2  # standard deviation of log scales of alignments by chance
_LEAST_SHARE = 0.01  # of alignments by chance with a moderate stretch
_MOST_NAMED = 5  # keypoints, in a message
_OUTLIER = 8.0  # [sigma], of a depth of another object


def whitening_matrices(whitening: FloatArray) -> FloatArray:
    """Whitening (n, 3) as upper triangular matrices (n, 2, 2); see `whitening_of`."""
    matrices = np.zeros((len(whitening), 2, 2))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1] = whitening.T
    return matrices


def loss_weights(squares: FloatArray, loss: int, bend: float) -> FloatArray:
    """Derivatives of a loss by squared lengths."""
    if loss == HUBER:
        return np.asarray(bend / np.sqrt(np.maximum(squares, bend**2)))
    return 1.0 / (1.0 + squares / bend**2) if loss == CAUCHY else np.ones_like(squares)


def chi_square_tail(value: float, freedom: int) -> float:
    """Probability that a chi-squared variable exceeds a value.

    Abramowitz and Stegun, 26.4.4 and 26.4.5; SciPy would import slowly.
    """
    if value <= 0 or value == math.inf:
        return float(value <= 0)
    half = value / 2
    powers = np.arange(freedom % 2 / 2, freedom / 2)
    steps = np.log(np.maximum(powers, 0.5))
    steps[:1] = math.lgamma(1 + freedom % 2 / 2)
    terms = float(np.exp(powers * math.log(half) - half - np.cumsum(steps)).sum())
    return terms + math.erfc(math.sqrt(half)) if freedom % 2 else terms


def chance_of(squares: float, redundancy: int, degrees_of_freedom: float | None = None) -> float:
    """Probability of a larger sum of squares; learned shapes have t-distributed tails."""
    if redundancy <= 0 or squares <= redundancy:
        return 1.0
    if degrees_of_freedom is None:
        return chi_square_tail(squares, redundancy)
    return float(1 - probability_within(squares, redundancy, degrees_of_freedom))


@lru_cache(maxsize=64)
def chi_square_quantile(freedom: int, probability: float) -> float:
    """The value that a chi-squared variable exceeds with a probability."""
    low, high = 0.0, float(freedom)
    while chi_square_tail(high, freedom) > probability:
        low, high = high, 2 * high
    while True:
        middle = (low + high) / 2
        if middle in (low, high):
            return high
        is_above = chi_square_tail(middle, freedom) > probability
        low, high = (middle, high) if is_above else (low, middle)


def f_quantile(first: float, second: float, probability: float) -> float:
    """The value that an F-distributed variable exceeds with a probability."""
    from scipy.special import fdtri  # only where sigma is estimated

    return float(fdtri(first, second, 1 - probability))


class Support(NamedTuple):
    """Inliers' ``errors`` (k,) [px] among ``given`` keypoints, and ``area`` [px^2] of outliers."""

    errors: FloatArray
    given: int
    area: float


def area_of(points_2d: FloatArray, camera: Camera, max_reproj_error: float) -> float:
    """The area [px^2] of outliers among keypoints (n, 2)."""
    with np.errstate(over="ignore"):  # an infinite extent is larger than the image
        extent = np.ptp(points_2d, axis=0) + 2 * max_reproj_error
        return min(float(np.prod(extent)), float(camera.width) * float(camera.height))


def check_support(
    supports: Sequence[Support],
    size: int,
    *,
    max_reproj_error: float,
    score: float,
    where: str,
    solutions: float = MAX_SOLUTIONS,
    chance: float = 0.1,
    share: float = 1.0,
) -> None:
    """Raise NoConsensusError if chance explains the support of all poses together.

    ``size`` keypoints have ``solutions`` alignments; ``score`` is the truncated sum of squares
    [px^2]. ``chance`` bounds the expected number of random alignments with equal support, of which
    a ``share`` has as moderate a stretch.
    """
    logarithm = sum(min(0.0, log_expected_by_chance(each, size, solutions)) for each in supports)
    if logarithm < 0 and share < 1:  # for the product of both
        logarithm += math.log(share)
        logarithm += math.log1p(-logarithm)
    if np.isfinite(score) and logarithm <= math.log(chance):
        return
    inliers, count = sum(len(each.errors) for each in supports), sum(n for _, n, _ in supports)
    raise NoConsensusError(
        f"no alignment is supported: the best has {inliers} of {count} keypoints within "
        f"{max_reproj_error:g} px, no more than by chance (score {score:.4g} px^2)",
        where=where,
        fix="check the correspondences and the camera, raise max_reproj_error or max_iterations, "
        'or use loss="cauchy" for a model that is only similar',
    )


def share_as_moderate(scale: FloatArray, free: int) -> float:
    """The share of alignments by chance with at most the stretch of ``scale`` (3,).

    Random keypoints support alignments that are stretched by factors of 25 and more in ``free``
    axes.
    """
    largest = float(np.abs(np.log(scale)).max())
    return max(math.erf(largest / (math.sqrt(2) * _CHANCE_STRETCH)) ** free, _LEAST_SHARE)


def named_keypoints(errors: Mapping[Any, float]) -> str:
    """Names of keypoints with finite errors [px], the largest first."""
    worst = sorted(errors, key=lambda row: -errors[row])
    listed = ", ".join(
        f"{row} ({errors[row]:.3g} px)" if np.isfinite(errors[row]) else f"{row}"
        for row in worst[:_MOST_NAMED]
    )
    more = f" and {len(worst) - _MOST_NAMED} more" if len(worst) > _MOST_NAMED else ""
    return f"{listed}{more}"


def log_expected_by_chance(support: Support, size: int, solutions: float) -> float:
    """Log of the expected number of equally supported alignments of random keypoints.

    Moisan, Stival, "A probabilistic criterion to detect rigid point matches between two images and
    estimate the fundamental matrix", 2004. For the k best keypoints, count all choices of these and
    of a sample, times the probability that the others lie within the largest error. The result is
    the minimum over small k and the largest k, where it is attained.
    """
    errors, count, area = support
    if len(errors) <= size:
        return math.inf
    radii = np.maximum(np.sort(errors), LEAST_ERROR)
    logarithms = [
        math.log(solutions * (count - size))
        + _log_choose(count, k)
        + _log_choose(k, size)
        + (k - size) * min(0.0, math.log(math.pi * radii[k - 1] ** 2 / area))
        for k in {*range(size + 1, min(size + 12, len(errors) + 1)), len(errors)}
    ]
    return float(min(logarithms))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)


def summaries_of(evidence: Evidence, state: State) -> list[EvidenceSummary]:
    """Summaries of depths, gravity, camera heights and lengths."""
    points, poses = points_of(evidence.shape, state), state.poses
    some = kept_rows(evidence.sightings, evidence.sightings.depths[:, 1] > 0)
    depths = depths_along_axes(evidence, poses, points[some.point], some.image) - some.depths[:, 0]
    directions, offsets = evidence.directions, evidence.offsets
    seen = [
        seen_in_cameras(evidence, poses, ends, directions.image)
        for ends in (directions.model, 0.0 * directions.model)
    ]
    turned = seen[0] - seen[1] - directions.camera
    across = np.linalg.norm(np.einsum("nij,nj->ni", directions.whitening, turned), axis=1)
    angles = np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(turned, axis=1) / 2, 1.0)))
    lengths = distances_of(evidence, poses, points) - offsets.value
    tables = (
        ("depth", some.image, depths, depths * some.depths[:, 1], "", 1),
        ("gravity", directions.image, angles, across, "deg", 2),
        ("length", offsets.image, lengths, lengths * offsets.weight, "", 1),
    )
    found = []
    for kind, image, errors, whitened, unit, equations in tables:
        for view in np.unique(image).tolist():
            rows = image == view
            counted = rows & (np.abs(whitened) < _OUTLIER)
            rows = counted if counted.any() else rows
            count = int(rows.sum())
            in_sigmas = float(np.sqrt((whitened[rows] ** 2).sum() / (equations * count)))
            rms = float(np.sqrt((errors[rows] ** 2).mean()))
            name = kind if kind != "length" else "size" if view < 0 else "camera height"
            number = None if view < 0 else view
            found.append(EvidenceSummary(name, number, count, in_sigmas, rms, unit))
    return found
