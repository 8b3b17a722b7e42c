"""The optimum of `fit`, and its covariance against the Cramer-Rao bound.

The bound, and the refinement from the truth that `fit` is compared with, are computed here, in
plain NumPy, for all problems of a row at once; nothing of them is shared with the solvers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Camera, Results, fit_batch
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem

pytestmark = pytest.mark.slow

PROBLEMS = 2000


@dataclass(frozen=True)
class Row:
    """Problems of equal size as arrays over them: points, pixels, focal lengths, the truth."""

    points_3d: np.ndarray
    points_2d: np.ndarray
    camera: Camera
    rotation: np.ndarray
    translation: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, problems: list[SimulatedProblem]) -> Row:
        return cls(
            np.array([p.points_3d for p in problems]),
            np.array([p.points_2d for p in problems]),
            problems[0].camera,
            np.array([p.alignment.rotation for p in problems]),
            np.array([p.alignment.translation for p in problems]),
            np.array([p.alignment.scale for p in problems]),
        )


def simulated_row(points: int, noise_px: float, *, count: int = PROBLEMS) -> list[SimulatedProblem]:
    rng = np.random.default_rng([0, points, round(1000 * noise_px)])
    return [simulate_problem(rng, points=points, noise_px=noise_px) for _ in range(count)]


def linearized(
    row: Row, rotation: np.ndarray, translation: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (B, 2n + 2) [px] and their Jacobian (B, 2n + 2, 8) by central differences.

    The unknowns are a rotation vector in the camera frame, the translation, log s_y, log s_z. The
    last two residuals are those of the prior on the stretch, for a noise of 1 px.
    """
    step = 1e-6

    def project(unknown: int, size: float) -> np.ndarray:
        turned, moved, stretched = rotation, translation, scale
        if unknown < 3:
            turned = Rotation.from_rotvec(size * np.eye(3)[unknown]).as_matrix() @ rotation
        elif unknown < 6:
            moved = translation + size * np.eye(3)[unknown - 3]
        else:
            stretched = scale * np.exp(size * np.eye(3)[unknown - 5])
        inside = (row.points_3d * stretched[:, None]) @ turned.transpose(0, 2, 1) + moved[:, None]
        image = inside[..., :2] / inside[..., 2:]
        pixels = image * [row.camera.fx, row.camera.fy] + [row.camera.cx, row.camera.cy]
        return np.hstack([pixels.reshape(len(pixels), -1), of_prior(stretched)])

    jacobian = np.stack(
        [(project(k, step) - project(k, -step)) / (2 * step) for k in range(8)], axis=2
    )
    observed = row.points_2d.reshape(len(jacobian), -1)
    return project(0, 0.0) - np.hstack([observed, np.zeros((len(observed), 2))]), jacobian


def of_prior(scale: np.ndarray) -> np.ndarray:
    """Residuals (B, 2) of scales (B, 3): 0 from 1/5 to 5, with flanks of 0.5 in the logarithm."""
    logs = np.log(scale[:, 1:])
    return np.sign(logs) * np.maximum(np.abs(logs) - np.log(5), 0) / 0.5


def bound_covariances(row: Row, noise_px: float) -> np.ndarray:
    """The Cramer-Rao bound of every problem, (B, 8, 8)."""
    _, jacobian = linearized(row, row.rotation, row.translation, row.scale)
    return noise_px**2 * np.linalg.inv(jacobian.transpose(0, 2, 1) @ jacobian)


# --- the optimum -----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(("points", "allowed"), [(6, 0.005), (7, 0.002), (10, 0.001)])
def test_optimum_is_hardly_ever_worse_than_the_truth(points: int, allowed: float) -> None:
    """A minimum that is not the lowest has, with few exceptions, a cost above that of the truth."""
    problems = simulated_row(points, 1.0)
    row = Row.of(problems)
    of_truth, _ = linearized(row, row.rotation, row.translation, row.scale)
    batch = fit_batch(
        [p.points_3d for p in problems], [p.points_2d for p in problems], problems[0].camera
    )
    reached = points * batch.rms**2 + (of_prior(batch.scale) ** 2).sum(axis=1)
    missed = ~(reached <= (of_truth**2).sum(axis=1))
    assert missed.mean() < allowed, f"missed in problems {np.flatnonzero(missed).tolist()}"


# --- the covariance --------------------------------------------------------------------------

UNKNOWN = [0, 1, 2, 3, 4, 5, 7, 8]  # x has the scale 1


def fisher_covariances(batch: Results) -> np.ndarray:
    return np.array([each.fisher_covariance for each in batch])


@pytest.mark.long
def test_covariance_at_the_truth_is_the_cramer_rao_bound() -> None:
    """What `fit` reports for noise-free keypoints is the bound computed here."""
    problems = simulated_row(12, 0.0, count=200)
    bound = bound_covariances(Row.of(problems), 1.0)
    batch = fit_batch(
        [p.points_3d for p in problems], [p.points_2d for p in problems], problems[0].camera
    )
    deviation = np.sqrt(np.einsum("bii->bi", bound))
    difference = np.abs(fisher_covariances(batch)[:, UNKNOWN][:, :, UNKNOWN] - bound)
    assert (difference < 1e-3 * deviation[:, :, None] * deviation[:, None]).all()
