"""Projection and its derivatives, against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera
from cadalign.geometry.camera import projection_jacobian
from cadalign.geometry.pixels import perspective
from cadalign.solvers.alignment import (
    Objective,
    empty_equations,
    evaluate_alignment,
    evaluate_cost,
    solve_damped,
)
from cadalign.solvers.constants import CAUCHY, HUBER, LINEAR, UNKNOWNS
from cadalign.solvers.evidence import KeypointEvidence, ScalePrior
from cadalign.solvers.projection import project_point, ray_derivatives, scalars_of
from cadalign.solvers.unknowns import move_pose

PLAIN = Camera(640, 480, 600, 620, 315, 245)
LENS = Camera(640, 480, 600, 620, 315, 245, (-0.2, 0.05, 0.001, -0.002))
STEP = 1e-6

seeds = st.integers(0, 2**32 - 1)


def pose_and_points(seed: int, count: int = 7) -> tuple[Alignment, np.ndarray]:
    """A random alignment and model points in front of the camera; some rotations near identity."""
    rng = np.random.default_rng(seed)
    vector = rng.normal(size=3) * rng.choice([1e-9, 1e-3, 1.0, 3.0])
    alignment = Alignment(
        Rotation.from_rotvec(vector).as_matrix(),
        [*rng.uniform(-0.5, 0.5, 2), rng.uniform(5, 9)],
        rng.uniform(0.5, 2, 3),
    )
    return alignment, rng.uniform(-1, 1, (count, 3))


def move_pose_by(pose: np.ndarray, unknown: int, step: float) -> np.ndarray:
    there = np.empty_like(pose)
    move_pose(pose, step * np.eye(UNKNOWNS)[unknown], there)
    return there


def project(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.array([project_point(scalars_of(pose), tuple(point))[:2] for point in points])


@given(seed=seeds)
def test_kernel_equals_alignment_and_perspective(seed: int) -> None:
    alignment, points = pose_and_points(seed)
    rays = perspective(alignment.apply(points))
    np.testing.assert_allclose(project(alignment.vector, points), rays, rtol=0, atol=1e-14)


@given(seed=seeds)
def test_ray_derivatives_equal_finite_differences(seed: int) -> None:
    alignment, points = pose_and_points(seed)
    pose = alignment.vector
    numerical = [
        (
            project(move_pose_by(pose, k, STEP), points)
            - project(move_pose_by(pose, k, -STEP), points)
        )
        / (2 * STEP)
        for k in range(UNKNOWNS)
    ]
    np.testing.assert_allclose(
        ray_derivatives(points, pose), np.moveaxis(numerical, 0, -1), rtol=0, atol=1e-8
    )


@pytest.mark.slow
@given(seed=seeds, camera=st.sampled_from([PLAIN, LENS]))
def test_pixel_derivatives_equal_finite_differences(seed: int, camera: Camera) -> None:
    alignment, points = pose_and_points(seed)

    def pixels(unknown: int, step: float) -> np.ndarray:
        turn, shift, stretch = np.zeros(3), np.zeros(3), np.zeros(3)
        lens = camera
        if unknown < 3:
            turn[unknown] = step
        elif unknown < 6:
            shift[unknown - 3] = step
        elif unknown < 9:
            stretch[unknown - 6] = step
        else:
            lens = camera.replace_focal(camera.fx * np.exp(step))
        changed = Alignment(
            Rotation.from_rotvec(turn).as_matrix() @ alignment.rotation,
            alignment.translation + shift,
            alignment.scale * np.exp(stretch),
        )
        return lens.project(changed.apply(points))

    jacobian = projection_jacobian(points, camera, alignment)
    for k in range(10):
        numerical = (pixels(k, STEP) - pixels(k, -STEP)) / (2 * STEP)
        np.testing.assert_allclose(jacobian[:, :, k], numerical, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("loss", [LINEAR, HUBER, CAUCHY])
@given(
    seed=seeds,
    each=st.booleans(),
    weight=st.sampled_from([0.0, 10.0]),
    width=st.sampled_from([0.0, 0.2]),
)
@settings(max_examples=30)
def test_gradient_of_all_evidence_is_the_gradient_of_the_cost(
    loss: int, seed: int, each: bool, weight: float, width: float
) -> None:
    alignment, points = pose_and_points(seed, 40)  # more than a block of points
    rng = np.random.default_rng(seed)
    pose = alignment.vector
    count = len(points) if each else 1
    free = np.array([1.0, 1, 1, 1, 1, 1, 1, rng.integers(2)])
    objective = Objective(
        free,
        KeypointEvidence(
            points,
            perspective(alignment.apply(points)) + rng.normal(scale=0.02, size=(len(points), 2)),
            np.abs(rng.normal(100, 10, (count, 3))),
            loss,
            2.0,
        ),
        ScalePrior(weight, width),
    )
    room = empty_equations(UNKNOWNS)
    cost = evaluate_alignment(objective, pose, room)
    hessian, gradient = room.hessian, room.gradient
    assert cost == pytest.approx(evaluate_cost(objective, pose), rel=1e-12)
    np.testing.assert_array_equal(hessian, hessian.T)
    for k in range(UNKNOWNS):
        ahead, behind = (evaluate_cost(objective, move_pose_by(pose, k, s)) for s in (STEP, -STEP))
        slope = free[k] * (ahead - behind) / (4 * STEP)  # the gradient is half that of the cost
        assert gradient[k] == pytest.approx(slope, rel=1e-5, abs=1e-4 * np.sqrt(cost))


def test_an_unknown_without_evidence_keeps_its_value() -> None:
    equations, step = empty_equations(3), np.empty(3)
    equations.hessian[:] = np.diag([4.0, 1e-3, 0.0])
    equations.gradient[:] = 2.0, 1e-3, 0.0
    assert solve_damped(equations, 3, 0.0, step) == pytest.approx(1.0 + 1e-3)
    np.testing.assert_allclose(step, [-0.5, -1.0, 0.0])
