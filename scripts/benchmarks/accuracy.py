"""Accuracy of the solvers relative to the Cramer-Rao bound."""

from __future__ import annotations

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray
from cadalign.evaluation.metrics.errors import scaled_columns
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.geometry.camera import projection_jacobian
from cadalign.metrics import rotation_error

_ROWS = ((6, 1.0), (7, 1.0), (10, 1.0), (20, 1.0), (100, 2.0), (1024, 2.0), (1024, 10.0))
_METHODS = ("optimal", "aepnp", "aepnp-paper")
_LIMIT_DRAWS = 20  # errors of an ideal estimator per problem
_SCALE_X = 6  # row of a bound


def accuracy(given: BenchmarkData) -> Tables:
    """Rotation errors relative to the Cramer-Rao bound: median and 90th percentile."""
    rows = [_over_bound(*each, given.count or 2000, given.seed) for each in _ROWS]
    yield "Rotation errors: Cramer-Rao bound [deg], and ratios to it", rows


def _over_bound(points: int, noise: float, count: int, seed: int) -> Row:
    """Rotation errors of an ideal estimator [deg], and ratios of every method to them."""
    rng = np.random.default_rng(seed)
    problems = [simulate_problem(rng, points=points, noise_px=noise) for _ in range(count)]
    bounds = [section.attempt(cramer_rao_bound, each, sigma=noise) for each in problems]
    drawn = [_ideal_errors(bound, rng) for bound in bounds if bound is not None]
    ideal = section.spread(np.concatenate(drawn))
    row: Row = {"problems": f"{points} points, {noise:g} px", "bound, deg": ideal}
    for method in _METHODS:
        sigma = noise if method == "optimal" else 1.0
        errors = [_error(each, method, sigma) for each in problems]
        row[method] = tuple(np.divide(section.spread(errors), ideal).tolist())
    return row


def _error(problem: SimulatedProblem, method: str, sigma: float) -> float:
    """Rotation error [deg]; 180 if the fit fails."""
    given = problem.points_3d, problem.points_2d, problem.camera
    found = section.attempt(cadalign.fit, *given, method=method, sigma=sigma)
    return 180.0 if found is None else rotation_error(est=found.alignment, gt=problem.alignment)


def cramer_rao_bound(problem: SimulatedProblem, *, sigma: float) -> FloatArray:
    """Inverse Fisher information (9, 9) at the truth, ordered as `cadalign.Result.covariance`."""
    used = np.delete(np.arange(9), _SCALE_X)
    jacobian = projection_jacobian(problem.points_3d, problem.camera, problem.alignment)
    scaled, norms = scaled_columns(jacobian[:, :, used].reshape(-1, len(used)) / sigma)
    covariance = np.zeros((9, 9))
    covariance[np.ix_(used, used)] = np.linalg.inv(scaled.T @ scaled) / np.outer(norms, norms)
    return covariance


def _ideal_errors(bound: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Rotation errors of an ideal estimator [deg]: Gaussian, with the bound as covariance."""
    free = np.flatnonzero(bound.diagonal())
    own, mean = bound[np.ix_(free, free)], np.zeros(len(free))
    errors = rng.multivariate_normal(mean, own, size=_LIMIT_DRAWS, method="eigh")
    return np.degrees(np.linalg.norm(errors[:, :3], axis=1))
