"""Probability that the object is none of a library's models; distances between shapes.

Two hypotheses are compared. In the first, the object is model k of the library, stretched, and its
keypoints in the image have the covariances C_i of the options. In the second, the object differs
from its nearest model k by an unknown deviation tau per coordinate, as a share of the extent e of
the keypoints in the image: their covariances are ``C_i + (tau e)^2 I``. All k are equally likely in
both. Pose and stretch are integrated out by Laplace's method, with a flat prior of the pose and the
options' prior of the stretch. Then tau changes the likelihood of model k by the factor::

    B_k(tau) = l_k(tau) / l_k(0)
    log l_k(tau) = - sum over the shared keypoints [log det(C_i(tau)) + |r_i|^2] / 2
                   - sum of (log stretch / stretch_sigma)^2 / 2 - log det(H) / 2

with the whitened errors r_i and the Hessian H at the optimum; a robust loss replaces the squares.
The logarithm of tau is Gaussian. Its mean and standard deviation (at least `LEAST_SPREAD`) are
taken from the distances between the models in the category of k and their nearest models of another
shape. With equal prior probabilities, the odds of the second hypothesis are::

    sum over k of score_k E[B_k(tau)]

The sum is over the most likely models, which contribute nearly all of it. With four keypoints the
probability is near 1/2, since any model fits them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.problems import whitening_of
from cadalign.retrieval.models import LibraryModel, ModelTable
from cadalign.retrieval.ranking import (
    CandidateSet,
    ObservedKeypoints,
    Ranking,
    apply_loss,
    shared_keypoints,
)
from cadalign.solvers.projection import ray_derivatives

SAME_SHAPE = 0.01
"""Distance below which two models count as the same shape."""
LEAST_SPREAD = 0.7
"""Least standard deviation of log tau, since objects of other categories are farther away."""
_MOST_LIKELY = 40  # number of models in the sum
_STEPS = np.linspace(-2.5, 2.5, 11)  # of log tau, in standard deviations
_USUAL = (np.log(0.03), 1.0)  # mean and standard deviation of log tau with fewer than 2 distances
_FARTHEST = 1.0  # largest tau
_MOST_SAMPLED = 64  # largest number of a category's models whose nearest models are searched
_LEAST_SHARED = 4
_RIDGE = 1e-12  # added to the Hessian, in case an unknown is not determined


def none_probability(
    table: ModelTable,
    candidates: CandidateSet,
    observed: ObservedKeypoints,
    ranking: Ranking,
) -> float:
    """Probability that the object is none of the models; see the module docstring."""
    chosen = ranking.candidates[:_MOST_LIKELY].tolist()
    shared = [shared_keypoints(candidates, observed, candidate) for candidate in chosen]
    alike: dict[tuple[str, int], list[int]] = {}  # ranks of the models to compute together
    for place, row in enumerate(candidates.models[chosen].tolist()):
        alike.setdefault((table.keys[row][0], len(shared[place][1])), []).append(place)
    extent = float(np.linalg.norm(np.ptp(observed.points_2d, axis=0)))
    shares = np.exp(-0.5 * _STEPS**2)
    shares = np.log(shares / shares.sum())[:, None]
    factors = np.empty(len(chosen))
    for (name, _), places in alike.items():
        center, spread = deviation_of(table, name)
        taus = np.concatenate([[0.0], np.exp(center + spread * _STEPS)])
        covariances = observed.covariances + (taus * extent)[:, None, None, None] ** 2 * np.eye(2)
        points, rows = (np.array([shared[place][k] for place in places]) for k in range(2))
        poses = ranking.poses[places]
        logs = _log_likelihoods(poses, points, rows, observed, covariances)
        factors[places] = np.logaddexp.reduce(logs[1:] + shares, axis=0) - logs[0]
    relative = ranking.log_likelihoods[:_MOST_LIKELY] - ranking.log_likelihoods[0]
    odds = np.logaddexp.reduce(relative + factors) - np.logaddexp.reduce(relative)
    return float(np.exp(-np.logaddexp(0.0, -odds)))


def _log_likelihoods(
    poses: FloatArray,
    points_3d: FloatArray,
    rows: IntArray,
    observed: ObservedKeypoints,
    covariances: FloatArray,
) -> FloatArray:
    """Log of l_k, (t, m), for m models and t covariances (t, all keypoints, 2, 2).

    The poses (m, 15) are optimal for the first covariances. All models share n keypoints (m, n, 3)
    with the image, where they have the ``rows`` (m, n).
    """
    query = observed.query
    count = len(covariances)
    rays = np.tile(query.rays, (count, 1))
    white = whitening_of(covariances.reshape(-1, 2, 2), rays, observed.facing)
    a, b, c = white.reshape(count, -1, 3)[:, rows].transpose(3, 0, 1, 2)  # (t, m, n) each
    columns = poses[:, :9].reshape(-1, 3, 3) * poses[:, None, 12:]
    points_cam = points_3d @ columns.swapaxes(1, 2) + poses[:, None, 9:12]
    errors = points_cam[..., :2] / points_cam[..., 2:] - query.rays[rows]
    free = np.flatnonzero(query.free)
    derivatives = np.array(list(map(ray_derivatives, points_3d, poses)))[..., free]
    u, v = derivatives[:, :, 0], derivatives[:, :, 1]
    jacobian = np.concatenate([a[..., None] * u + b[..., None] * v, c[..., None] * v], axis=2)
    across, down = a * errors[..., 0] + b * errors[..., 1], c * errors[..., 1]
    stretches = np.pad(np.log(poses[:, 13:]), ((0, 0), (6, 0)))[:, free]
    prior = np.repeat([0.0, query.prior_weight], [6, 2])[free]
    transposed = jacobian.swapaxes(2, 3)
    hessian = transposed @ jacobian + np.diag(prior)
    hessian += _RIDGE * np.trace(hessian, axis1=2, axis2=3)[..., None, None] * np.eye(len(free))
    residuals = np.concatenate([across, down], axis=2)[..., None]
    slope = transposed @ residuals + (prior * stretches)[..., None]
    # The optimum for a larger deviation is one Newton step from the given pose.
    gain = (slope * np.linalg.solve(hessian, slope)).sum(axis=(2, 3))
    gain[0] = 0.0
    costs = apply_loss(across**2 + down**2, query.loss, query.loss_scale).sum(axis=2)
    costs += (prior * stretches**2).sum(axis=1) - gain
    determinants = np.log(np.linalg.det(covariances))[:, rows].sum(axis=2)
    return np.asarray(-0.5 * (determinants + costs + np.linalg.slogdet(hessian)[1]))


@lru_cache(maxsize=256)
def deviation_of(table: ModelTable, category: str) -> tuple[float, float]:
    """Mean and standard deviation of log tau, from distances between a category's models."""
    _, points = table.keypoints_of(category)
    sampled = points[:: -(-len(points) // _MOST_SAMPLED)]
    gaps = np.array([distances(points, each, least=_LEAST_SHARED) for each in sampled])
    gaps = np.where(gaps > SAME_SHAPE, gaps, np.inf).min(axis=1)
    nearest = np.minimum(gaps[np.isfinite(gaps)] / np.sqrt(3), _FARTHEST)
    if len(nearest) < 2:
        return _USUAL
    logs = np.log(nearest)
    return float(np.mean(logs)), max(float(np.std(logs)), LEAST_SPREAD)


def shape_distance(est: LibraryModel, gt: LibraryModel) -> float:
    """Root mean square distance of the shared keypoints, as a share of the true keypoints' extent.

    The estimated model is first translated, and stretched along y and z (x is assumed to be known),
    to be closest to the true model; it is not rotated. NaN with fewer than 2 shared keypoints.

    Examples
    --------
    >>> xyz = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    >>> bounds = np.array([[0, 0, 0], [1, 1, 1.0]])
    >>> one = LibraryModel("box", "1", xyz, np.arange(4), bounds)
    >>> two = LibraryModel("box", "2", xyz * [1, 2, 0.5] + 0.1, np.arange(4), bounds)
    >>> round(shape_distance(two, one), 12)
    0.0
    """
    if est.category != gt.category:
        raise InputError(f"the categories {est.category!r} and {gt.category!r} differ", where="est")
    _, mine, theirs = np.intersect1d(est.ids, gt.ids, return_indices=True)
    return float(distances(est.xyz[None, mine], gt.xyz[theirs])[0])


def distances(est: FloatArray, gt: FloatArray, *, least: int = 2) -> FloatArray:
    """Shape distances of models' keypoints (m, k, 3) from a model's (k, 3), (m,) float.

    Missing keypoints are NaN; shared ones are compared. The distance is NaN with fewer than
    ``least`` shared keypoints.
    """
    # In the order keypoints, axes, models, the sums are fast.
    moved, wanted = np.ascontiguousarray(est.transpose(1, 2, 0)), gt[:, :, None]
    known = ~np.isnan(moved[:, :1] + wanted[:, :1])
    counts = known.sum(axis=(0, 1))
    numbers = np.maximum(counts, 1)
    moved, wanted = np.where(known, moved, 0.0), np.where(known, wanted, 0.0)
    moved -= known * (sum(moved) / numbers)
    wanted -= known * (sum(wanted) / numbers)
    squares, products = sum(moved**2), sum(moved * wanted)
    # A mirrored or flat model has the stretch 0.
    scale = np.maximum(products, 0.0) / np.where(squares > 0, squares, 1.0)
    scale[0] = 1.0
    gaps = ((moved * scale - wanted) ** 2).sum(axis=1)
    extent = float(np.linalg.norm(np.ptp(gt[~np.isnan(gt[:, 0])], axis=0))) or np.nan
    found = np.sqrt(np.ascontiguousarray(gaps.T).sum(axis=1) / numbers) / extent
    return np.asarray(np.where(counts >= least, found, np.nan))
