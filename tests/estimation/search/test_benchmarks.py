"""Benchmarks of the parts, and the ratios to OpenCV's speed that must hold.

``make bench`` measures them; in the test suite each part runs once.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from support.problems import problem_of
from support.timing import ratio, timed

from cadalign import Box, RansacOptions, fit, fit_batch
from cadalign.evaluation.simulation import random_rotation
from cadalign.metrics import box_iou
from cadalign.solvers import aepnp, aepnp_paper, ap4p


@pytest.mark.parametrize("points", [10, 1024])
@pytest.mark.parametrize("solver", [aepnp, aepnp_paper], ids=["aepnp", "aepnp_paper"])
def test_linear_solvers(
    benchmark: BenchmarkFixture, solver: Callable[..., object], points: int
) -> None:
    problem = problem_of(points, points=points, noise_px=1.0)
    benchmark(solver, problem.points_3d, problem.camera.normalize(problem.points_2d))


def test_minimal_solver(benchmark: BenchmarkFixture) -> None:
    problem = problem_of(4, points=4, noise_px=0.0)
    benchmark(ap4p, problem.points_3d, problem.camera.normalize(problem.points_2d))


@pytest.mark.parametrize("points", [6, 10, 100, 1024])
@pytest.mark.parametrize("method", ["optimal", "aepnp"])
def test_fit(benchmark: BenchmarkFixture, method: str, points: int) -> None:
    problem = problem_of(points, points=points, noise_px=1.0)
    benchmark(fit, problem.points_3d, problem.points_2d, problem.camera, method=method)


@pytest.mark.parametrize("workers", [1, -1])
def test_fit_batch(benchmark: BenchmarkFixture, workers: int) -> None:
    problem = problem_of(10, points=10, noise_px=1.0)
    points_3d = np.tile(problem.points_3d, (1000, 1, 1))
    points_2d = np.tile(problem.points_2d, (1000, 1, 1))
    benchmark(fit_batch, points_3d, points_2d, problem.camera, method="aepnp", workers=workers)


def test_robust_fit(benchmark: BenchmarkFixture) -> None:
    problem = problem_of(200, points=200, noise_px=1.0)
    points_2d = problem.points_2d.copy()
    points_2d[::2] = np.random.default_rng(0).uniform(0, 480, (100, 2))
    benchmark(fit, problem.points_3d, points_2d, problem.camera, ransac=RansacOptions(), sigma=1.0)


def test_box_iou(benchmark: BenchmarkFixture) -> None:
    rng = np.random.default_rng(0)
    est, gt = (Box(rng.normal(size=3) / 4, random_rotation(rng), [1, 2, 3]) for _ in range(2))
    benchmark(box_iou, est=est, gt=gt)


@pytest.mark.timing
@pytest.mark.parametrize(
    ("points", "solver_limit", "linear_limit", "optimal_limit"),
    [(10, 0.3, 1.2, 1.5), (100, 0.25, 1.0, 1.2), (1024, 0.2, 0.5, 0.7), (4096, 0.2, 0.4, 0.7)],
)
def test_times_over_opencv(
    points: int, solver_limit: float, linear_limit: float, optimal_limit: float
) -> None:
    problem = problem_of(points, points=points, noise_px=1.0)
    x, uv, camera = problem.points_3d, problem.points_2d, problem.camera
    rays, matrix = camera.normalize(uv), camera.matrix

    def epnp() -> object:
        return cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_EPNP)

    def iterative() -> object:
        return cv2.solvePnP(x, uv, matrix, None)

    for ours, theirs, limit in (
        (lambda: aepnp(x, rays), epnp, solver_limit),
        (lambda: fit(x, uv, camera, method="aepnp"), epnp, linear_limit),
        (lambda: fit(x, uv, camera), iterative, optimal_limit),
    ):
        turns = timed(ours, calls=10), timed(theirs, calls=10)
        assert ratio(*turns, below=limit, rounds=15) < limit
