"""Symmetries: discrete motions, axes, their products, and rotation errors up to them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign.errors import InputError
from cadalign.evaluation.metrics.photos import scan2cad_errors
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import nearest_rotation
from cadalign.geometry.symmetry import Symmetry, SymmetryAxis
from cadalign.metrics import rotation_error

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def pose(rotation):
    return Alignment(rotation.as_matrix(), [0, 0, 1], [1, 1, 1])


@pytest.mark.parametrize("fold", [1, 2, 3, 4, 6])
def test_rotations_by_equal_angles_are_a_group(fold):
    motions = Symmetry.around((0, 3, 0), fold=fold, offset=(0.1, 5, -0.2)).motions
    poses = np.array([np.eye(4), *motions])
    assert len(poses) == fold
    for first in poses:
        np.testing.assert_allclose(first @ [0.1, 0, -0.2, 1], [0.1, 0, -0.2, 1], atol=1e-12)
        for second in poses:
            gaps = np.abs(poses - first @ second).max(axis=(1, 2))
            assert gaps.min() < 1e-12


@pytest.mark.parametrize("fold", [0, -3, True, 2.5, "2"])
def test_what_is_no_number_of_rotations_is_refused(fold):
    with pytest.raises(InputError, match=rf"^fold: '{fold}' is no number of rotations; give"):
        Symmetry.around((0, 1, 0), fold=fold)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
def test_the_error_about_an_axis_is_the_least_over_all_angles(seed):
    """Flips turn the axis round, so that all motions are those about it, after a flip or none."""
    direction = np.array([0.0, *np.random.default_rng(seed).normal(size=2)])
    symmetry = Symmetry(FLIP[None], (SymmetryAxis(direction, np.zeros(3)),))
    est, gt = pose(Rotation.random(random_state=seed)), pose(Rotation.random(random_state=seed + 9))
    exact = rotation_error(est=est, gt=gt, symmetry=symmetry)
    tried = [
        rotation_error(est=est, gt=Alignment(gt.rotation @ motion[:3, :3], [0, 0, 1], [1, 1, 1]))
        for angle in np.arange(0, 2 * np.pi, 0.004)
        for motion in (symmetry.axes[0].turned(angle), symmetry.axes[0].turned(angle) @ FLIP)
    ]
    assert exact <= min(tried) + 1e-9
    assert exact == pytest.approx(min(tried), abs=0.01)


def test_the_error_is_the_least_over_all_turns():
    est, gt = pose(Rotation.from_euler("y", 25, degrees=True)), pose(Rotation.identity())
    assert rotation_error(est=est, gt=gt, symmetry=Symmetry.none()) == pytest.approx(25)
    # 25 deg is 25 from 0 and 20 from 45, of the rotations by 0, 45, 90, ... deg.
    eight = Symmetry.around((0, 1, 0), fold=8)
    assert rotation_error(est=est, gt=gt, symmetry=eight) == pytest.approx(20)


def test_no_turn_of_a_ball_is_an_error_by_any_metric():
    """Two axes make every rotation, also those that no turn about one of them reaches."""
    axes = tuple(SymmetryAxis(np.eye(3)[row], np.zeros(3)) for row in (0, 1))
    turned = {"est": pose(Rotation.random(random_state=1)), "gt": pose(Rotation.identity())}
    ball = Symmetry(np.empty((0, 4, 4)), axes)
    assert rotation_error(**turned, symmetry=ball) == pytest.approx(0, abs=1e-5)
    assert scan2cad_errors(**turned, symmetry=ball)["rotation_error_deg"] == pytest.approx(
        0, abs=1e-5
    )


def test_what_is_no_motion_is_refused():
    with pytest.raises(InputError, match="not a rigid"):
        Symmetry(np.diag([1.0, 1, -1, 1])[None])
    with pytest.raises(InputError, match="not a rigid"):
        Symmetry(np.diag([2.0, 1, 1, 1])[None])
    with pytest.raises(InputError, match="no direction"):
        SymmetryAxis(np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match="not a rotation"):
        nearest_rotation(np.diag([1.0, 1, -1]))
    with pytest.raises(InputError, match="not a rotation"):
        nearest_rotation(np.full((3, 3), np.inf))


@pytest.mark.parametrize(
    ("data", "count", "axes"),
    [
        ({"axis": [0, 1, 0], "fold": 1}, 0, 0),
        ({"axis": [0, 0, 2], "fold": 3, "offset": [1, 0, 0]}, 2, 0),
        ({"axis": [0, 0, 2], "fold": None}, 0, 1),
        ({"symmetries_discrete": [FLIP.ravel().tolist()]}, 1, 0),
        ({"symmetries_continuous": [{"axis": [0, 1, 0], "offset": [0, 0, 1]}]}, 0, 1),
    ],
)
def test_every_form_is_read_and_written_as_bop_does(data, count, axes):
    symmetry = Symmetry.from_dict(data)
    assert (len(symmetry.motions), len(symmetry.axes)) == (count, axes)
    again = Symmetry.from_dict(symmetry.to_dict())
    assert again.to_dict() == symmetry.to_dict()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (4, "symmetry: expected an object, got int"),
        ({}, "symmetry: the fields"),
        ({"axis": [0, 1, 0]}, "symmetry: the fields axis are no symmetry's"),
        ({"axis": [0, 1], "fold": 2}, "symmetry.axis: "),
        ({"axis": [0, 1, 0], "fold": 0}, "symmetry.fold: '0' is no number of rotations"),
        ({"symmetries_discrete": [[1, 2]]}, r"symmetry.symmetries_discrete\[0\]: "),
        ({"symmetries_discrete": 3}, "symmetry.symmetries_discrete: expected a list"),
        ({"symmetries_continuous": [3]}, "symmetry.axis: "),
    ],
)
def test_other_forms_are_refused_by_their_field(data, message):
    with pytest.raises(InputError, match=message):
        Symmetry.from_dict(data)
