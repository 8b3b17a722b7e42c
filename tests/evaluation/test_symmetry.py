"""Symmetries: only rotations that map a model onto itself are no errors."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import Alignment
from cadalign.arrays import FloatArray
from cadalign.datasets.keypoints import (
    Circle,
    RotationalSymmetry,
    Symmetries,
    annotated_symmetry,
)
from cadalign.evaluation.simulation import random_rotation
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry
from cadalign.metrics import rotation_error, translation_error

Y = np.array([0.0, 1.0, 0.0])
SQUARE = np.array([[1.0, 0, 1], [1, 0, -1], [-1, 0, -1], [-1, 0, 1]])


def bottle() -> tuple[FloatArray, Symmetries]:
    """Two rings of four and a point on the axis, off the origin."""
    center = np.array([0.02, 0.0, -0.03])
    xyz = np.concatenate([0.1 * SQUARE, 0.05 * SQUARE + [0, 0.6, 0], [[0, 0.8, 0]]]) + center
    circles = [
        RotationalSymmetry((0, 1, 2, 3), Circle(center, 0.14, Y)),
        RotationalSymmetry((4, 5, 6, 7), Circle(center + [0, 0.6, 0], 0.07, -Y)),
    ]
    return xyz, Symmetries(rotations=tuple(circles))


def table() -> tuple[FloatArray, Symmetries]:
    """A rectangular table: two mirrors, so a rotation by 180 degrees is a symmetry."""
    corners = SQUARE * [0.5, 1, 0.3]
    xyz = np.concatenate([corners, corners + [0, 0.4, 0]])
    ring = ((0, 1), (1, 2), (2, 3), (3, 0))
    upper = tuple((a + 4, b + 4) for a, b in ring)
    return xyz, Symmetries(reflections=ring + upper)


def errors(group: Symmetry, est: Alignment, gt: Alignment) -> tuple[float, float]:
    truth = group.nearest_pose(gt, est.rotation)
    return rotation_error(est=est, gt=truth), translation_error(est=est, gt=truth)


def some_truth(seed: int = 0) -> Alignment:
    rng = np.random.default_rng(seed)
    return Alignment(random_rotation(rng), [0.3, -0.2, 4.0], [1.0, 0.6, 1.7])


def turned(gt: Alignment, group: Symmetry, rotation: FloatArray) -> Alignment:
    """The alignment of the object rotated about the group's centre."""
    shift = gt.rotation @ (group.center - rotation @ group.center)
    return Alignment(gt.rotation @ rotation, gt.translation + shift, gt.scale)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 90.0, 179.9, -120.0])
def test_a_bottle_turned_about_its_axis_is_no_error(degrees: float) -> None:
    group = annotated_symmetry(*bottle())
    assert str(group) == "circle"
    gt = some_truth()
    est = turned(gt, group, rotation_from_vector(Y * np.radians(degrees)))
    assert errors(group, est, gt) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert rotation_error(est=est, gt=gt) == pytest.approx(abs(degrees), abs=1e-6)


def test_a_tilted_bottle_keeps_the_error_of_its_tilt() -> None:
    group = annotated_symmetry(*bottle())
    gt = some_truth()
    tilt = rotation_from_vector(np.array([np.radians(12.0), 0.0, 0.0]))
    est = turned(gt, group, tilt @ rotation_from_vector(Y * np.radians(75.0)))
    assert errors(group, est, gt)[0] == pytest.approx(12.0, abs=1e-6)


@pytest.mark.long
def test_the_nearest_angle_is_the_best_of_all() -> None:
    group = annotated_symmetry(*bottle())
    for seed in range(20):
        gt = some_truth(seed)
        est = Alignment(random_rotation(np.random.default_rng(seed + 99)), [0, 0, 4], [1, 1, 1])
        best, _ = errors(group, est, gt)
        searched = min(
            rotation_error(est=est, gt=turned(gt, group, rotation_from_vector(Y * angle)))
            for angle in np.linspace(0, 2 * np.pi, 721)
        )
        assert best <= searched + 1e-9
        assert best == pytest.approx(searched, abs=0.5)


def test_a_handle_ends_the_circle() -> None:
    xyz, symmetries = bottle()
    with_handle = np.concatenate([xyz, [[0.3, 0.3, 0.0]]])
    assert annotated_symmetry(with_handle, symmetries).is_trivial


def test_two_mirrors_make_a_half_turn() -> None:
    group = annotated_symmetry(*table())
    assert len(group.rotations) == 2
    gt = some_truth()
    assert errors(group, turned(gt, group, rotation_from_vector(Y * np.pi)), gt) == pytest.approx(
        (0.0, 0.0), abs=1e-6
    )
    quarter = turned(gt, group, rotation_from_vector(Y * np.pi / 2))
    assert errors(group, quarter, gt)[0] == pytest.approx(90.0, abs=1e-6)


def test_one_mirror_is_no_rotation() -> None:
    xyz = np.array([[0.3, 0, 0.1], [-0.3, 0, 0.1], [0.2, 0.5, 0], [-0.2, 0.5, 0]])
    assert annotated_symmetry(xyz, Symmetries(reflections=((0, 1), (2, 3)))).is_trivial


def test_the_feet_of_an_office_chair_are_no_symmetry_of_the_chair() -> None:
    angles = 2 * np.pi * np.arange(5) / 5
    feet = 0.3 * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    rotations = (RotationalSymmetry((0, 1, 2, 3, 4)),)
    with_hub = np.concatenate([feet, [[0.0, 0.2, 0.0]]])
    assert len(annotated_symmetry(with_hub, Symmetries(rotations=rotations)).rotations) == 5
    with_back = np.concatenate([with_hub, [[0.0, 0.8, -0.3]]])
    assert annotated_symmetry(with_back, Symmetries(rotations=rotations)).is_trivial
