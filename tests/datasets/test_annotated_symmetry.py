"""Symmetries computed from KeypointNet's annotation."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.datasets.keypoints import (
    Circle,
    RotationalSymmetry,
    Symmetries,
    annotated_symmetry,
)

Y = np.array([0.0, 1.0, 0.0])


def test_annotated_quarters_make_a_group_of_four():
    """A stool's seat corners and feet, off the origin, each annotated as one rotation."""
    square = np.array([[1, 0, 1], [1, 0, -1], [-1, 0, -1], [-1, 0, 1]])
    xyz = np.concatenate([square, 0.8 * square + Y]) * 0.2 + [0.1, 0.3, 0]
    turned = (RotationalSymmetry((0, 1, 2, 3)), RotationalSymmetry((4, 5, 6, 7)))
    symmetry = annotated_symmetry(xyz, Symmetries(rotations=turned))
    assert len(symmetry.rotations) == 4
    for rotation in symmetry.rotations:
        moved = (xyz - symmetry.center) @ rotation.T + symmetry.center
        gaps = np.linalg.norm(moved[:, None] - xyz, axis=2)
        np.testing.assert_allclose(gaps.min(axis=1), 0, atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_square_is_turned_by_quarters_about_its_own_axis_alone(axis):
    """If equivalent keypoints alternate, only half turns are symmetries."""
    corners = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    xyz = np.roll(corners, (axis + 1) % 3, axis=1) + [[0.1, 0.2, 0.3]]
    for groups, angles in ((((0, 1, 2, 3),), [90, 180, 270]), (((0, 2), (1, 3)), [180])):
        symmetries = Symmetries(rotations=tuple(map(RotationalSymmetry, groups)))
        turns = annotated_symmetry(xyz, symmetries).rotations[1:]
        about = turns[np.isclose(turns[:, axis, axis], 1)]
        cosines = (np.trace(about, axis1=1, axis2=2) - 1) / 2
        np.testing.assert_allclose(cosines, np.cos(np.radians(angles)), atol=1e-12)


def test_a_circle_makes_an_axis():
    rim = np.array([[0.5, 1, 0], [-0.5, 1, 0], [0, 1, 0.5]])
    circle = Circle(center=Y, normal=Y, radius=0.5)
    symmetries = Symmetries(rotations=(RotationalSymmetry((0, 1, 2), circle=circle),))
    symmetry = annotated_symmetry(np.concatenate([rim, [[0, 0, 0]]]), symmetries)
    (axis,) = symmetry.axes
    np.testing.assert_allclose(np.abs(axis), Y, atol=1e-12)


def test_without_annotation_there_is_none():
    assert annotated_symmetry(np.eye(3), Symmetries()).is_trivial
