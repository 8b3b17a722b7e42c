"""Symmetries: groups, files, equivalent alignments of stretched models, and errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import angles_between, nearest_rotation, rotation_from_vector
from cadalign.geometry.symmetry import FACING, Symmetry
from cadalign.metrics import rotation_error

UP = (0.0, 1.0, 0.0)
FLIP = np.diag([1.0, -1.0, -1.0])
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)

numbers = st.floats(-3, 3, allow_nan=False)
vectors = arrays(float, 3, elements=numbers)
folds = st.sampled_from([1, 2, 3, 4, 5, 6, 8, 12])
turns = vectors.map(rotation_from_vector)


def symmetries():
    def about(direction, fold, offset):
        return Symmetry.around(np.array(direction), fold=fold, offset=offset)

    direction = st.sampled_from([UP, (0, 0, 1), (1, 0, 0), (1, 2, -2)])
    around = st.builds(about, direction, folds | st.none(), vectors)
    discs = st.builds(lambda center: Symmetry(center, FLIP[None], np.array([UP])), vectors)
    return around | discs


def draw_motion(group, data):
    """Draw a motion (4, 4) of the group."""
    rotation = group.rotations[data.draw(st.integers(0, len(group.rotations) - 1))]
    if len(group.axes):
        rotation = rotation_from_vector(data.draw(numbers) * group.axes[0]) @ rotation
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, group.center - rotation @ group.center
    return motion


def move(alignment, motion):
    """Move the model of an alignment by a motion."""
    return Alignment(
        alignment.rotation @ motion[:3, :3],
        alignment.translation + alignment.linear @ motion[:3, 3],
        alignment.scale,
    )


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(symmetries())
def test_a_group_is_closed_and_has_inverses(group):
    for first in group.rotations:
        for second in (*group.rotations, *(each.T for each in group.rotations)):
            product = first @ second
            if len(group.axes):  # up to a rotation about the axis
                about = group.axes[0]
                cosines = [about @ product.T @ each @ about for each in group.rotations]
                assert max(cosines) == pytest.approx(1)
            else:
                assert min(angles_between(product, each) for each in group.rotations) < 1e-6


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(symmetries(), turns, vectors, st.floats(0.5, 2), turns | st.none(), st.data())
def test_equivalent_alignments_have_the_same_canonical_one(
    group, rotation, translation, size, reference, data
):
    alignment = Alignment(rotation, translation, np.full(3, size))
    equal = move(alignment, draw_motion(group, data))
    first = group.canonical(alignment, reference=reference).alignment
    second = group.canonical(equal, reference=reference).alignment
    again = group.canonical(first, reference=reference).alignment
    near = FACING if reference is None else reference
    # Nearest to the reference; ties remain only for special rotations.
    assert angles_between(first.rotation, near) == pytest.approx(
        angles_between(second.rotation, near), abs=1e-3
    )
    assert angles_between(first.rotation, near) <= angles_between(equal.rotation, near) + 1e-3
    np.testing.assert_allclose(again.rotation, first.rotation, atol=1e-6)
    np.testing.assert_allclose(second.rotation, first.rotation, atol=2e-5)
    np.testing.assert_allclose(second.translation, first.translation, atol=2e-4)


@pytest.mark.long
@settings(max_examples=80, deadline=None)
@given(folds, turns, st.floats(0.5, 2), st.floats(0.5, 2))
def test_the_motion_leads_to_the_canonical_alignment(fold, rotation, across, up):
    symmetry = Symmetry.around(UP, fold=fold, offset=(0.2, 0.0, -0.3))
    alignment = Alignment(rotation, [0.1, 0.2, 5], [across, up, across])
    found = symmetry.canonical(alignment, held=(True, False, False))
    np.testing.assert_allclose(found.alignment.scale, alignment.scale)
    np.testing.assert_allclose(
        found.alignment.apply(found.map_points(CUBE)), alignment.apply(CUBE), atol=1e-9
    )


def count_equal(group, alignment, held):
    """Number of equivalent alignments; None for infinitely many."""
    kept = list(group._allowed_branches(alignment.scale, held, 1e-4))
    return None if any(len(axes) for (_, axes), _ in kept) else len(kept)


def test_a_stretch_across_an_axis_keeps_half_turns():
    """A stretched circle, an ellipse, keeps half turns; quarter turns exchange its axes."""
    group = Symmetry.around(UP, fold=None)
    free, held = (False, False, False), (True, False, False)
    round_one = Alignment(np.eye(3), [0, 0, 5], [1.1, 2, 1.1])
    flat = Alignment(np.eye(3), [0, 0, 5], [1, 2, 1.5])
    assert count_equal(group, round_one, free) is None
    assert (count_equal(group, flat, held), count_equal(group, flat, free)) == (2, 4)


def test_a_quarter_turn_exchanges_stretches():
    group = Symmetry.around(UP, fold=4)
    long, wide = [1.0, 1.2, 1.5], [1.5, 1.2, 1.0]
    quarter = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()
    first = Alignment(FACING, [0, 0, 5], long)
    second = Alignment(FACING @ quarter, [0, 0, 5], wide)
    np.testing.assert_allclose(
        sorted(first.apply(CUBE).round(9).tolist()), sorted(second.apply(CUBE).round(9).tolist())
    )
    found = group.canonical(second)
    np.testing.assert_allclose(found.alignment.rotation, FACING, atol=1e-12)
    np.testing.assert_allclose(found.alignment.scale, long)
    # If x is held, the turned alignment is not allowed.
    kept = group.canonical(second, held=(True, False, False)).alignment
    np.testing.assert_allclose(kept.scale, wide)
    assert angles_between(kept.rotation, second.rotation) in (0.0, pytest.approx(180))
    assert count_equal(group, first, (True, False, False)) == 2


def test_the_cube_has_24_rotations():
    quarters = np.array([Symmetry.around(axis, fold=4).rotations[1] for axis in np.eye(3)[:2]])
    assert len(Symmetry(np.zeros(3), quarters).rotations) == 24
    assert Symmetry.none().is_trivial


@pytest.mark.long
def test_a_rotation_of_high_order_is_refused():
    late = rotation_from_vector(2 * np.pi / 301 * np.array(UP))
    with pytest.raises(InputError, match="more than 240 rotations"):
        Symmetry(np.zeros(3), late[None])


def pose(rotation):
    return Alignment(rotation.as_matrix(), [0, 0, 1], [1, 1, 1])


@pytest.mark.parametrize("fold", [1, 2, 3, 4, 6])
def test_rotations_by_equal_angles_are_a_group(fold):
    symmetry = Symmetry.around((0, 3, 0), fold=fold, offset=(0.1, 5, -0.2))
    assert symmetry.center.tolist() == [0.1, 5, -0.2]
    assert len(symmetry.rotations) == fold
    np.testing.assert_allclose(symmetry.rotations[:, 1], [UP] * fold, atol=1e-12)


@pytest.mark.parametrize("fold", [0, -3, True, 2.5, "2", 10**9])
def test_wrong_numbers_of_rotations_are_refused(fold):
    with pytest.raises(InputError, match=rf"^symmetry.fold: '{fold}' is not a number of rotations"):
        Symmetry.around((0, 1, 0), fold=fold)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
def test_the_error_with_an_axis_is_the_least_over_all_angles(seed):
    """A flip reverses the axis; all motions are rotations about it, with or without the flip."""
    direction = np.array([0.0, *np.random.default_rng(seed).normal(size=2)])
    symmetry = Symmetry(np.zeros(3), FLIP[None], direction[None])
    est, gt = pose(Rotation.random(random_state=seed)), pose(Rotation.random(random_state=seed + 9))
    exact = rotation_error(est=est, gt=gt, symmetry=symmetry)
    turns = (rotation_from_vector(a * symmetry.axes[0]) for a in np.arange(0, 2 * np.pi, 0.004))
    tried = [
        rotation_error(est=est, gt=Alignment(gt.rotation @ turn @ flip, [0, 0, 1], [1, 1, 1]))
        for turn in turns
        for flip in (np.eye(3), FLIP)
    ]
    assert exact <= min(tried) + 1e-9
    assert exact == pytest.approx(min(tried), abs=0.01)


def test_the_error_is_the_least_over_all_turns():
    est, gt = pose(Rotation.from_euler("y", 25, degrees=True)), pose(Rotation.identity())
    assert rotation_error(est=est, gt=gt, symmetry=Symmetry.none()) == pytest.approx(25)
    # The rotations are by 0, 45, 90, ... deg; the nearest to 25 deg is 45.
    eight = Symmetry.around((0, 1, 0), fold=8)
    assert rotation_error(est=est, gt=gt, symmetry=eight) == pytest.approx(20)


def test_wrong_rotations_and_axes_are_refused():
    with pytest.raises(InputError, match=r"symmetry.rotations\[0\]: not a rotation"):
        Symmetry(np.zeros(3), np.diag([1.0, 1, -1])[None])
    with pytest.raises(InputError, match="not a rotation"):
        nearest_rotation(np.full((3, 3), np.inf))
    with pytest.raises(InputError, match=r"symmetry.axis: the axis has no direction"):
        Symmetry.around(np.zeros(3), fold=2)
    quarter = Symmetry.around((1, 0, 0), fold=4).rotations[1:2]
    for rotations, axes in ((np.empty((0, 3, 3)), np.eye(3)[:2]), (quarter, np.eye(3)[1:2])):
        with pytest.raises(InputError, match="any rotation is a symmetry, as of a ball; leave out"):
            Symmetry(np.zeros(3), rotations, axes)


DISC = {"center": [0, 0, 1], "rotations": [np.eye(3).tolist()], "axes": [[0, 1, 0]]}


@pytest.mark.parametrize(
    ("data", "count", "axes"),
    [
        ({"axis": [0, 1, 0], "fold": 1}, 1, 0),
        ({"axis": [0, 0, 2], "fold": 3, "offset": [1, 0, 0]}, 3, 0),
        ({"axis": [0, 0, 2], "fold": None}, 1, 1),
        ({"center": [0, 0, 0], "rotations": [FLIP.tolist()], "axes": []}, 2, 0),
        (DISC, 1, 1),
    ],
)
def test_every_form_is_read_and_written(data, count, axes):
    symmetry = Symmetry.from_dict(data)
    assert (len(symmetry.rotations), len(symmetry.axes)) == (count, axes)
    again = Symmetry.from_dict(symmetry.to_dict())
    assert again.to_dict() == symmetry.to_dict()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (4, "symmetry: expected an object, got int"),
        ({}, "symmetry: the fields"),
        ({"axis": [0, 1, 0]}, "symmetry: the fields axis are not a symmetry"),
        ({"axis": [0, 1], "fold": 2}, "symmetry.axis: "),
        ({"axis": [0, 1, 0], "fold": 0}, "symmetry.fold: '0' is not a number of rotations"),
        (DISC | {"rotations": [[1, 2]]}, "symmetry.rotations: shape"),
        (DISC | {"axes": 3}, "symmetry.axes: shape"),
        (
            {"symmetries_discrete": []},
            "symmetry: the fields symmetries_discrete are not a symmetry",
        ),
    ],
)
def test_wrong_forms_are_refused_by_field(data, message):
    with pytest.raises(InputError, match=message):
        Symmetry.from_dict(data)
