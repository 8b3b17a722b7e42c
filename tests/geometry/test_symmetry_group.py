"""Groups of symmetries: closure, equal alignments under stretch, the canonical one, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import angle_between, rotation_from_vector
from cadalign.geometry.symmetry import Symmetry, SymmetryAxis
from cadalign.geometry.symmetry_group import FACING, SymmetryGroup

UP = (0.0, 1.0, 0.0)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
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
    discs = st.builds(
        lambda offset: Symmetry(shifted(FLIP, offset)[None], (SymmetryAxis(np.array(UP), offset),)),
        vectors,
    )
    spheres = st.builds(
        lambda offset: Symmetry(
            np.empty((0, 4, 4)), tuple(SymmetryAxis(axis, offset) for axis in np.eye(3)[:2])
        ),
        vectors,
    )
    return around | discs | spheres


def shifted(motion, center):
    """The same rotation about another point."""
    moved = motion.copy()
    moved[:3, 3] = center - motion[:3, :3] @ center
    return moved


def element(symmetry, group, data):
    """Any motion of the group."""
    if group.is_free:
        rotation = data.draw(turns)
    else:
        rotation = group.rotations[data.draw(st.integers(0, len(group.rotations) - 1))]
    if group.axis is not None:
        rotation = rotation_from_vector(data.draw(numbers) * group.axis) @ rotation
    motion = np.eye(4)
    motion[:3, :3] = rotation
    return shifted(motion, group.center)


def placed(alignment, motion):
    """An alignment of equal stretches after a motion of the model."""
    return Alignment(
        alignment.rotation @ motion[:3, :3],
        alignment.translation + alignment.linear @ motion[:3, 3],
        alignment.scale,
    )


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(symmetries())
def test_a_group_is_closed_and_has_inverses(symmetry):
    group = SymmetryGroup.of(symmetry)
    for first in group.rotations:
        for second in (*group.rotations, *(each.T for each in group.rotations)):
            product = first @ second
            if group.axis is not None:  # but for a rotation about the axis
                assert max(abs(group.axis @ product.T @ each @ group.axis) for each in
                           group.rotations) == pytest.approx(1)  # fmt: skip
            else:
                assert min(angle_between(product, each) for each in group.rotations) < 1e-6
    for motion in symmetry.motions:
        np.testing.assert_allclose(motion[:3, :3] @ group.center + motion[:3, 3], group.center,
                                   atol=1e-9)  # fmt: skip


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(symmetries(), turns, vectors, st.floats(0.5, 2), turns | st.none(), st.data())
def test_the_canonical_alignment_is_that_of_all_equal_ones(
    symmetry, rotation, translation, size, reference, data
):
    group = SymmetryGroup.of(symmetry)
    alignment = Alignment(rotation, translation, np.full(3, size))
    equal = placed(alignment, element(symmetry, group, data))
    first = group.canonical(alignment, reference=reference).alignment
    second = group.canonical(equal, reference=reference).alignment
    again = group.canonical(first, reference=reference).alignment
    near = FACING if reference is None else reference
    # The nearest to the reference; beyond that ties may remain for special rotations alone.
    assert angle_between(first.rotation, near) == pytest.approx(
        angle_between(second.rotation, near), abs=1e-3
    )
    assert angle_between(first.rotation, near) <= angle_between(equal.rotation, near) + 1e-3
    np.testing.assert_allclose(again.rotation, first.rotation, atol=1e-6)
    np.testing.assert_allclose(second.rotation, first.rotation, atol=2e-5)
    np.testing.assert_allclose(second.translation, first.translation, atol=2e-4)


@pytest.mark.long
@settings(max_examples=80, deadline=None)
@given(folds, turns, st.floats(0.5, 2), st.floats(0.5, 2))
def test_the_motion_leads_to_the_canonical_alignment(fold, rotation, across, up):
    symmetry = Symmetry.around(UP, fold=fold, offset=(0.2, 0.0, -0.3))
    alignment = Alignment(rotation, [0.1, 0.2, 5], [across, up, across])
    found = SymmetryGroup.of(symmetry).canonical(alignment, held=(True, False, False))
    np.testing.assert_allclose(found.alignment.scale, alignment.scale)
    np.testing.assert_allclose(
        found.alignment.apply(found.relabelled(CUBE)), alignment.apply(CUBE), atol=1e-9
    )


def count_equal(group, alignment, held):
    """Number of alignments that are equal to one; None for any number."""
    kept = list(group._kept(alignment.scale, held, 1e-4))
    return None if any(len(axes) for (_, axes), _ in kept) else len(kept)


def test_of_an_axis_a_stretch_across_it_leaves_half_turns():
    """The ellipse under the stretched circle is that of half turns and exchanged axes alone."""
    group = SymmetryGroup.of(Symmetry.around(UP, fold=None))
    free, held = (False, False, False), (True, False, False)
    round_one = Alignment(np.eye(3), [0, 0, 5], [1.1, 2, 1.1])
    flat = Alignment(np.eye(3), [0, 0, 5], [1, 2, 1.5])
    assert count_equal(group, round_one, free) is None
    assert (count_equal(group, flat, held), count_equal(group, flat, free)) == (2, 4)


def test_a_quarter_turn_exchanges_the_stretches_it_turns():
    group = SymmetryGroup.of(Symmetry.around(UP, fold=4))
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
    # With x known, the turned one would be another size, and stays.
    kept = group.canonical(second, held=(True, False, False)).alignment
    np.testing.assert_allclose(kept.scale, wide)
    assert angle_between(kept.rotation, second.rotation) in (0.0, pytest.approx(180))
    assert count_equal(group, first, (True, False, False)) == 2


@pytest.mark.parametrize("scale", [(1, 1, 1), (1, 1.5, 1), (0.7, 1, 1), (1, 2, 3)])
def test_of_a_sphere_the_stretch_leaves_what_an_ellipsoid_has(scale):
    axes = tuple(SymmetryAxis(axis, np.zeros(3)) for axis in np.eye(3))
    group = SymmetryGroup.of(Symmetry(np.empty((0, 4, 4)), axes))
    alignment = Alignment(Rotation.random(random_state=3).as_matrix(), [0, 0, 9], scale)
    count = {1: None, 2: None, 3: 24}[len(set(scale))]
    assert count_equal(group, alignment, (False, False, False)) == count
    if count == 24:  # with the scales held, the half turns
        assert count_equal(group, alignment, (True, True, True)) == 4
    found = group.canonical(alignment)
    assert len(found.free) == {1: 3, 2: 1, 3: 0}[len(set(scale))]
    # The ellipsoid |S^-1 R' (x - t)| = 1 stays in place.
    before, after = (
        each.rotation @ np.diag(each.scale**2) @ each.rotation.T
        for each in (alignment, found.alignment)
    )
    np.testing.assert_allclose(before, after, atol=1e-9)


def test_the_cube_has_24_rotations():
    quarters = [Symmetry.around(axis, fold=4).motions[0] for axis in np.eye(3)[:2]]
    assert len(SymmetryGroup.of(Symmetry(np.array(quarters))).rotations) == 24
    assert SymmetryGroup.of(Symmetry.none()).is_trivial


def test_motions_without_a_common_point_are_refused():
    screw = np.eye(4)
    screw[:3, 3] = (0, 0.5, 0)
    with pytest.raises(InputError, match="keep no common point"):
        SymmetryGroup.of(Symmetry(screw[None]))
    apart = (Symmetry.around(UP, fold=2).motions[0], Symmetry.around(UP, fold=2, offset=(1, 0, 0)))
    with pytest.raises(InputError, match="keep no common point"):
        SymmetryGroup.of(Symmetry(np.stack([apart[0], apart[1].motions[0]])))


@pytest.mark.long
def test_a_rotation_that_returns_late_is_refused():
    late = Symmetry.around(UP, fold=301).motions[7:8]
    with pytest.raises(InputError, match="more than 240 rotations"):
        SymmetryGroup.of(Symmetry(late))
