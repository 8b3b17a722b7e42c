"""Example of a block of evidence: the vanishing point of a direction of the model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from support.sighted import sighted_evidence

from cadalign.arrays import FloatArray, IntArray
from cadalign.compile import kernel
from cadalign.solvers.joint.evidence import Evidence, Focals, Shape, State
from cadalign.solvers.joint.rows import BlockEquation, equations_of, plain_equation, write_equation
from cadalign.solvers.joint.search import equations_at, pack, refine_joint
from cadalign.solvers.linalg import cross, triple
from cadalign.solvers.projection import turn, turn_back


class VanishingPoints(NamedTuple):
    """Directions ``model`` (D, 3) that vanish at ``rays`` (D, 2) of views ``image`` (D,).

    Rays are for the focal lengths of the cameras; ``weight`` (D,) is their inverse standard
    deviation.
    """

    model: FloatArray
    rays: FloatArray
    image: IntArray
    weight: FloatArray


@equations_of.of(VanishingPoints)
@kernel
def _count_equations(points: VanishingPoints) -> int:
    return 2 * points.image.shape[0]


@write_equation.of(VanishingPoints)
@kernel
def _write_vanishing_point(
    points: VanishingPoints, evidence: Evidence, state: State, q: int, row: FloatArray
) -> BlockEquation:
    """Write the equation ``f d_x / d_z = u``, or of v, for the direction d in the camera."""
    n, axis = q // 2, q % 2
    v, weight = points.image[n], points.weight[n]
    camera, pose = evidence.rig.cam_from_rig[v], state.poses[evidence.rig.pose[v]]
    rotated = turn(pose, triple(points.model[n]))
    seen = turn(camera, rotated)
    group = evidence.focals.group[v]
    ratio = np.exp(state.log_focals[group]) if group >= 0 else 1.0
    place = ratio * seen[axis] / seen[2]
    by_seen = ratio * weight / seen[2]
    slopes = (
        by_seen if axis == 0 else 0.0,
        by_seen if axis == 1 else 0.0,
        -place * weight / seen[2],
    )
    row[0], row[1], row[2] = cross(rotated, turn_back(camera, slopes))
    if group >= 0:
        row[6 + group] = weight * place
    return plain_equation(evidence.rig.pose[v], weight * (place - points.rays[n, axis]))


UP = np.array([0.0, 1.0, 0.0])
FOCAL = 1.3  # relative to the rays' focal length
POSE = np.append(Rotation.from_rotvec([0.7, 0.3, 0.2]).as_matrix(), [0.1, 0.2, 9.0])


def evidence_of_one_view() -> Evidence:
    """Keypoints of a small, distant object, which hardly determine the focal length."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 3))
    seen = points @ POSE[:9].reshape(3, 3).T + POSE[9:]
    rays = FOCAL * seen[:, :2] / seen[:, 2:]
    rays += np.random.default_rng(1).normal(0, 1e-3, rays.shape)
    shape = Shape(points, np.empty((0, len(points), 3)), np.zeros(len(points)))
    unknown = Focals(np.zeros(1, dtype=np.int64), -np.ones(1), np.ones(1), np.zeros(1), np.zeros(1))
    return sighted_evidence(shape, rays, unknown)


def add_vanishing_point(evidence: Evidence) -> Evidence:
    """Add the vanishing point of the object's up axis."""
    x, y, z = POSE[:9].reshape(3, 3) @ UP
    rays = FOCAL * np.array([[x / z, y / z]])
    image, weight = np.zeros(1, dtype=np.int64), np.array([500.0])
    return evidence.add_block(VanishingPoints(UP[None], rays, image, weight))


def state_at(turn_by: FloatArray, log_focal: float) -> State:
    """A state near the true one."""
    rotation = Rotation.from_rotvec(turn_by).as_matrix() @ POSE[:9].reshape(3, 3)
    poses = np.append(rotation, POSE[9:])[None]
    none = np.empty(0)
    return State(poses, np.array([log_focal]), np.zeros(3), none, np.zeros((8, 3)))


def test_gradient_of_a_custom_block_equals_finite_differences() -> None:
    evidence, step = add_vanishing_point(evidence_of_one_view()), 1e-6
    place = np.array([0.02, -0.03, 0.01])
    gradient = equations_at(evidence, pack(state_at(place, 0.2)))[1].gradient
    turned = Rotation.from_rotvec(place)
    for axis, by in enumerate(np.eye(3) * step):
        ends = [(Rotation.from_rotvec(s * by) * turned).as_rotvec() for s in (-1, 1)]
        before, after = (equations_at(evidence, pack(state_at(e, 0.2)))[0] for e in ends)
        np.testing.assert_allclose(gradient[axis], (after - before) / (4 * step), rtol=1e-5)
    before, after = (
        equations_at(evidence, pack(state_at(place, 0.2 + s * step)))[0] for s in (-1, 1)
    )
    np.testing.assert_allclose(gradient[6], (after - before) / (4 * step), rtol=1e-5)


def test_a_vanishing_point_determines_the_focal_length() -> None:
    evidence, start = evidence_of_one_view(), state_at(np.array([0.02, -0.03, 0.01]), 0.1)
    errors = []
    for each in (evidence, add_vanishing_point(evidence)):
        _, _, state = refine_joint(each, 100, start)
        errors.append(abs(float(state.log_focals[0]) - np.log(FOCAL)))
    assert errors[1] < 0.02
    assert errors[1] < errors[0] / 5
