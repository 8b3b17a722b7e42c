"""Probability that the object is none of a library's models, not even stretched.

Two hypotheses explain an image's keypoints. By the first, the object is model k of the library,
stretched, with the covariances C_i of its keypoints in the image that the options give. By the
second, it differs from k, its nearest model, by an unknown deviation tau per coordinate, as a
share of the extent e of the keypoints in the image: their covariances are ``C_i + (tau e)^2 I``.
All k are equally likely in both. What tau changes in the likelihood of model k is, with pose and
stretch integrated out by Laplace's method, a flat prior of the pose and the options' one of the
stretch::

    B_k(tau) = l_k(tau) / l_k(0)
    log l_k(tau) = - sum over the shared keypoints [log det(C_i(tau)) + |r_i|^2] / 2
                   - sum of (log stretch / stretch_sigma)^2 / 2 - log det(H) / 2

with the whitened errors r_i at the optimum, bent by a robust loss, and H the Hessian there. The
logarithm of tau is Gaussian; its mean and standard deviation are those of the distances from the
library's models to their nearest ones of another shape, in the category of k, the latter at least
`LEAST_SPREAD`. So the odds of the second hypothesis are::

    none_prior / (1 - none_prior) * sum over k of score_k E[B_k(tau)]

The sum is over the most likely models, which hold nearly all of it. Four keypoints, through which
any model passes, tell nothing: the probability is then near ``none_prior``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.problems import whitening_of
from cadalign.estimation.uncertainty.posterior import bent
from cadalign.retrieval.candidates import CandidateSet, Observed
from cadalign.retrieval.models import ModelTable
from cadalign.retrieval.options import RetrievalOptions
from cadalign.retrieval.ranking import Ranking, shared_keypoints
from cadalign.retrieval.shape import SAME_SHAPE
from cadalign.solvers.constants import UNKNOWNS

LEAST_SPREAD = 0.7
"""Least standard deviation of log tau: objects of other categories are farther away."""
_MOST_LIKELY = 40  # models that the sum is over
_STEPS = np.linspace(-2.5, 2.5, 11)  # of log tau, in its standard deviations
_USUAL = (np.log(0.03), 1.0)  # mean and deviation of log tau where there is nothing to compare
_FARTHEST = 1.0  # tau of two models that have nothing in common
_ASKED = 64  # models of a category whose nearest ones are looked for
_LEAST_SHARED = 4
_RIDGE = 1e-12  # of the Hessian, where keypoints leave an unknown open


def none_probability(
    table: ModelTable,
    candidates: CandidateSet,
    observed: Observed,
    ranking: Ranking,
    options: RetrievalOptions,
) -> float:
    """Compute the probability that the object is none of the models; see the module."""
    if options.none_prior == 0:
        return 0.0
    first = slice(_MOST_LIKELY)
    chosen = ranking.candidates[first].tolist()
    shared = [shared_keypoints(candidates, observed, candidate) for candidate in chosen]
    names = [table.keys[row][0] for row in candidates.models[chosen].tolist()]
    alike: dict[tuple[str, int], list[int]] = {}  # places of models that are computed together
    for place, (name, (_, rows)) in enumerate(zip(names, shared, strict=True)):
        alike.setdefault((name, len(rows)), []).append(place)
    factors = np.empty(len(chosen))
    for (name, _), places in alike.items():
        posed = _Posed(
            ranking.poses[places],
            np.array([shared[place][0] for place in places]),
            np.array([shared[place][1] for place in places]),
        )
        factors[places] = _log_factors(posed, observed, options, *deviation_of(table, name))
    relative = ranking.log_likelihoods[first] - ranking.log_likelihoods[0]
    odds = np.log(options.none_prior) - np.log1p(-options.none_prior)
    odds += np.logaddexp.reduce(relative + factors) - np.logaddexp.reduce(relative)
    return float(np.exp(-np.logaddexp(0.0, -odds)))


@dataclass(frozen=True, eq=False)
class _Posed:
    """Models at their optimal poses that share equally many keypoints with the image."""

    poses: FloatArray  # (m, 15)
    points_3d: FloatArray  # (m, n, 3)
    rows: IntArray  # (m, n), of the keypoints in the image


def _log_factors(
    posed: _Posed, observed: Observed, options: RetrievalOptions, center: float, spread: float
) -> FloatArray:
    """Logarithms of E[B_k(tau)] of models (m,), log tau having this mean and deviation."""
    extent = float(np.linalg.norm(np.ptp(observed.points_2d, axis=0)))
    taus = np.concatenate([[0.0], np.exp(center + spread * _STEPS)])
    covariances = observed.covariances + (taus * extent)[:, None, None, None] ** 2 * np.eye(2)
    logs = _log_likelihoods(posed, observed, covariances, options)
    weights = np.exp(-0.5 * _STEPS**2)
    means = np.logaddexp.reduce(logs[1:] + np.log(weights / weights.sum())[:, None], axis=0)
    return np.asarray(means - logs[0])


def _log_likelihoods(
    posed: _Posed, observed: Observed, covariances: FloatArray, options: RetrievalOptions
) -> FloatArray:
    """Log of l_k (t, m) for covariances (t, all keypoints, 2, 2), the poses optimal for t = 0."""
    query, fitting, rows = observed.query, options.fitting, posed.rows
    count = len(covariances)
    rays = np.tile(query.rays, (count, 1))
    white = whitening_of(covariances.reshape(-1, 2, 2), rays, observed.camera)
    a, b, c = white.reshape(count, -1, 3)[:, rows].transpose(3, 0, 1, 2)  # (t, m, n) each
    errors, derivatives = _linearised(posed, query.rays[rows])
    free = np.flatnonzero(query.free)
    u, v = derivatives[:, :, 0, free], derivatives[:, :, 1, free]
    jacobian = np.concatenate([a[..., None] * u + b[..., None] * v, c[..., None] * v], axis=2)
    across, down = a * errors[..., 0] + b * errors[..., 1], c * errors[..., 1]
    stretches = np.zeros((len(rows), UNKNOWNS))
    stretches[:, 6:] = np.log(posed.poses[:, 13:])
    prior = np.zeros(UNKNOWNS)
    prior[6:] = query.prior_weight
    prior, stretches = prior[free], stretches[:, free]
    transposed = jacobian.swapaxes(2, 3)
    hessian = transposed @ jacobian + np.diag(prior)
    hessian += _RIDGE * np.trace(hessian, axis1=2, axis2=3)[..., None, None] * np.eye(len(free))
    residuals = np.concatenate([across, down], axis=2)[..., None]
    slope = transposed @ residuals + (prior * stretches)[..., None]
    # The optimum of a larger deviation is a step from that of the noise alone.
    gain = (slope * np.linalg.solve(hessian, slope)).sum(axis=(2, 3))
    gain[0] = 0.0
    costs = bent(across**2 + down**2, fitting.loss, fitting.loss_scale).sum(axis=2)
    costs += (prior * stretches**2).sum(axis=1) - gain
    determinants = np.log(np.linalg.det(covariances))[:, rows].sum(axis=2)
    return np.asarray(-0.5 * (determinants + costs + np.linalg.slogdet(hessian)[1]))


def _linearised(posed: _Posed, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of the rays (m, n, 2), and their derivatives by the unknowns (m, n, 2, 8).

    The unknowns are the rotation vector, the translation, log s_y and log s_z.
    """
    rotations, scales = posed.poses[:, :9].reshape(-1, 3, 3), posed.poses[:, 12:]
    columns = rotations * scales[:, None]
    turned = posed.points_3d @ columns.swapaxes(1, 2)
    points_cam = turned + posed.poses[:, None, 9:12]
    x, y, z = np.moveaxis(turned, 2, 0)
    zero = np.zeros_like(x)
    by_rotation = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 3, 0, 1)
    by_translation = np.broadcast_to(np.eye(3), by_rotation.shape)
    by_scale = columns[:, None, :, 1:] * posed.points_3d[:, :, None, 1:]
    of_points = np.concatenate([by_rotation, by_translation, by_scale], axis=3)
    projected = points_cam[..., :2] / points_cam[..., 2:]
    derivatives = of_points[:, :, :2] - projected[..., None] * of_points[:, :, 2:]
    return projected - rays, derivatives / points_cam[..., 2, None, None]


@lru_cache(maxsize=256)
def deviation_of(table: ModelTable, category: str) -> tuple[float, float]:
    """Mean and standard deviation of log tau: from models of a category to their nearest ones."""
    points, has = _stacked(table, category)
    asked = np.arange(0, len(points), -(-len(points) // _ASKED))
    gaps = _distances(points, has, asked)
    gaps = np.where(gaps > SAME_SHAPE, gaps, np.inf).min(axis=1)
    nearest = np.minimum(gaps[np.isfinite(gaps)] / np.sqrt(3), _FARTHEST)
    if len(nearest) < 2:
        return _USUAL
    logs = np.log(nearest)
    return float(np.mean(logs)), max(float(np.std(logs)), LEAST_SPREAD)


def _stacked(table: ModelTable, category: str) -> tuple[FloatArray, BoolArray]:
    """Keypoints (m, k, 3) of a category's models, and which of them each has, (m, k)."""
    rows = table.rows_of(category)
    offsets = table.offsets[rows.start : rows.stop + 1]
    own = slice(int(offsets[0]), int(offsets[-1]))
    ids, column = np.unique(table.ids[own], return_inverse=True)
    model = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    points = np.zeros((len(offsets) - 1, len(ids), 3))
    has = np.zeros(points.shape[:2], dtype=bool)
    points[model, column] = table.xyz[own]
    has[model, column] = True
    return points, has


def _distances(points: FloatArray, has: BoolArray, rows: IntArray) -> FloatArray:
    """Distances (r, m) of all models from some, as `cadalign.retrieval.shape.shape_distance`.

    Means over the keypoints that two models share are products of matrices.
    """
    known, of_rows = has.astype(np.float64), has[rows].astype(np.float64)
    shared = of_rows @ known.T
    counts = np.maximum(shared, 1.0)
    square = np.zeros(shared.shape)
    for axis in range(3):
        every = known * points[:, :, axis]
        wanted = of_rows * points[rows, :, axis]
        mean, mean_wanted = of_rows @ every.T / counts, wanted @ known.T / counts
        moved = np.maximum(of_rows @ (every**2).T / counts - mean**2, 0.0)
        product = wanted @ every.T / counts - mean * mean_wanted
        fixed = wanted**2 @ known.T / counts - mean_wanted**2
        scale = np.maximum(product, 0.0) / np.where(moved > 0, moved, 1.0)
        if axis == 0:
            scale[:] = 1.0
        square += scale * (scale * moved - 2.0 * product) + fixed
    extents = [np.linalg.norm(np.ptp(points[row][has[row]], axis=0)) for row in rows.tolist()]
    with np.errstate(divide="ignore", invalid="ignore"):
        gaps = np.sqrt(np.maximum(square, 0.0)) / np.array(extents)[:, None]
    return np.asarray(np.where(shared >= _LEAST_SHARED, gaps, np.nan))
