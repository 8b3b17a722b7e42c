"""Accuracy of the solvers relative to the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment
from cadalign.evaluation.metrics.errors import limit_estimate
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.metrics import rotation_error

_ROWS = ((6, 1.0), (7, 1.0), (10, 1.0), (20, 1.0), (100, 2.0), (1024, 2.0), (1024, 10.0))
_METHODS = ("optimal", "aepnp", "aepnp-paper")


def accuracy(given: BenchmarkData) -> Tables:
    """Rotation errors relative to the Cramer-Rao bound: median and 90th percentile."""
    rows = [_over_bound(*each, given.count or 2000, given.seed) for each in _ROWS]
    yield "Rotation errors: Cramer-Rao bound [deg], and ratios to it", rows


def _over_bound(points: int, noise: float, count: int, seed: int) -> Row:
    """Rotation errors of an ideal estimator [deg], and ratios of every method to them."""
    rng = np.random.default_rng(seed)
    problems = [simulate_problem(rng, points=points, noise_px=noise) for _ in range(count)]
    ideal = section.spread([_error(each, limit_estimate, each.alignment) for each in problems])
    row: Row = {"problems": f"{points} points, {noise:g} px", "bound, deg": ideal}
    for method in _METHODS:
        call = partial(cadalign.fit, method=method, sigma=noise if method == "optimal" else 1.0)
        errors = [_error(each, call) for each in problems]
        row[method] = tuple(np.divide(section.spread(errors), ideal).tolist())
    return row


def _error(problem: SimulatedProblem, estimate: Callable[..., Any], *truth: Alignment) -> float:
    """Rotation error [deg]; 180 if the estimate fails."""
    given = problem.points_3d, problem.points_2d, problem.camera
    found = section.attempt(estimate, *given, *truth)
    pose = getattr(found, "alignment", found)
    return 180.0 if pose is None else rotation_error(est=pose, gt=problem.alignment)
