"""Random alignment problems, steps of the unknowns, and comparisons of alignments."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Result, fit
from cadalign.datasets import Correspondences
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.metrics import rotation_error

LENS = Camera(640, 480, 500.0, 520.0, 310.0, 250.0, (-0.25, 0.08, 0.004, -0.003))


def problem_of(
    seed: int, *, points: int = 12, noise_px: float = 0.5, **options: Any
) -> SimulatedProblem:
    """A synthetic problem, the same for the same seed."""
    return simulate_problem(
        np.random.default_rng(seed), points=points, noise_px=noise_px, **options
    )


def fit_problem(problem: SimulatedProblem, **options: Any) -> Result:
    return fit(problem.points_3d, problem.points_2d, problem.camera, **options)


def moved(alignment: Alignment, step: np.ndarray) -> Alignment:
    """The alignment after a step of the 8 unknowns, in the documented order."""
    return Alignment(
        Rotation.from_rotvec(step[:3]).as_matrix() @ alignment.rotation,
        alignment.translation + step[3:6],
        alignment.scale * np.exp([0.0, *step[6:8]]),
    )


def residuals_at(problem: SimulatedProblem, alignment: Alignment) -> np.ndarray:
    return problem.camera.project(alignment.apply(problem.points_3d)) - problem.points_2d


def assert_same(first: Alignment, second: Alignment, tolerance: float) -> None:
    assert rotation_error(est=first, gt=second) < np.degrees(tolerance)
    np.testing.assert_allclose(first.translation, second.translation, rtol=0, atol=10 * tolerance)
    np.testing.assert_allclose(first.scale, second.scale, rtol=10 * tolerance)


def assert_drawn_stretches_are_recovered(images: Iterable[Correspondences]) -> None:
    """The linear solver finds, in every image, by what the points were stretched."""
    rng = np.random.default_rng(0)
    for image in images:
        scale = np.array([1.0, *rng.uniform(0.5, 2, 2)])
        found = fit(image.points_3d / scale, image.points_2d, image.camera, method="aepnp")
        np.testing.assert_allclose(found.alignment.scale, scale, rtol=0.01)
        assert rotation_error(est=found.alignment, gt=image.cam_from_world) < 0.5


def with_outliers(
    points_2d: np.ndarray, outliers: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The image points (n, 2), those with the numbers ``outliers`` moved by 15 px or more."""
    moved_2d = points_2d.copy()
    low, high = points_2d.min(axis=0), points_2d.max(axis=0)
    for i in outliers:
        while np.linalg.norm(moved_2d[i] - points_2d[i]) < 15:
            moved_2d[i] = rng.uniform(low, high)
    return moved_2d


def of_unknowns(covariance: np.ndarray) -> np.ndarray:
    """The rows and columns of a result's covariance that belong to what is not held."""
    free = np.flatnonzero(covariance.diagonal())
    return covariance[np.ix_(free, free)]
