"""Alignment: algebra, validation and dictionaries."""

from __future__ import annotations

import copy
import json
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, View
from cadalign.errors import InputError


def rotation_matrix(vector: list[float]) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_matrix()


# Rotations of every angle, with samples near 0 and 180 degrees.
ANGLES = st.sampled_from([0.0, 1e-12, 1e-7, 1e-3, np.pi - 1e-7, np.pi]) | st.floats(0.0, np.pi)
AXES = st.sampled_from([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]) | st.integers(0, 2**32 - 1).map(
    lambda seed: (v := np.random.default_rng(seed).standard_normal(3)) / np.linalg.norm(v)
)
ROTATIONS = st.builds(lambda axis, angle: rotation_matrix(np.multiply(axis, angle)), AXES, ANGLES)
TRANSLATIONS = st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3)
SCALES = st.lists(st.floats(0.1, 10.0), min_size=3, max_size=3)
EQUAL_SCALES = st.floats(0.1, 10.0).map(lambda s: [s, s, s])
ALIGNMENTS = st.builds(Alignment, ROTATIONS, TRANSLATIONS, SCALES)
SIMILARITIES = st.builds(Alignment, ROTATIONS, TRANSLATIONS, EQUAL_SCALES)
POINTS = np.random.default_rng(0).uniform(-2, 2, (20, 3))


@pytest.mark.slow
@given(alignment=ALIGNMENTS)
def test_apply_is_rotation_times_stretch_plus_translation(alignment: Alignment) -> None:
    expected = [
        alignment.rotation @ np.diag(alignment.scale) @ x + alignment.translation for x in POINTS
    ]
    np.testing.assert_allclose(alignment.apply(POINTS), expected, rtol=0, atol=1e-11)


@given(alignment=ALIGNMENTS)
def test_matrix_agrees_with_apply(alignment: Alignment) -> None:
    homogeneous = np.column_stack([POINTS, np.ones(len(POINTS))])
    moved = homogeneous @ alignment.cam_from_model.T
    np.testing.assert_allclose(moved[:, :3], alignment.apply(POINTS), rtol=0, atol=1e-11)
    assert (moved[:, 3] == 1).all()
    assert (alignment.linear == alignment.cam_from_model[:3, :3]).all()


@given(alignment=ALIGNMENTS)
def test_inverse_inverts_apply_on_both_sides(alignment: Alignment) -> None:
    np.testing.assert_allclose(alignment.inverse(alignment.apply(POINTS)), POINTS, atol=1e-11)
    np.testing.assert_allclose(alignment.apply(alignment.inverse(POINTS)), POINTS, atol=1e-11)


@given(alignment=ALIGNMENTS)
def test_from_dict_inverts_to_dict_exactly_also_through_json(alignment: Alignment) -> None:
    again = Alignment.from_dict(json.loads(json.dumps(alignment.to_dict())))
    assert again == alignment
    assert hash(again) == hash(alignment)


def test_equality_compares_every_field() -> None:
    base = Alignment(np.eye(3), [0, 0, 4], [1, 2, 3])
    assert base == Alignment(np.eye(3), [0, 0, 4], [1, 2, 3])
    assert base != Alignment(np.eye(3), [0, 0, 4], [1, 2, 3.1])
    assert base != Alignment(np.eye(3), [0, 1, 4], [1, 2, 3])
    assert base != Alignment(np.diag([1.0, -1, -1]), [0, 0, 4], [1, 2, 3])
    assert base != "alignment"


def test_arrays_are_read_only_copies() -> None:
    translation = np.array([0.0, 0.0, 4.0])
    alignment = Alignment(np.eye(3), translation, np.ones(3))
    translation[2] = 5.0
    assert alignment.translation[2] == 4.0
    for array in (alignment.rotation, alignment.translation, alignment.scale):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7.0


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda a: pickle.loads(pickle.dumps(a))])
def test_copies_and_pickles_are_equal(duplicate: Any) -> None:
    alignment = Alignment(np.eye(3), [0, 0, 4], [1, 2, 3])
    assert duplicate(alignment) == alignment


@pytest.mark.parametrize("error", [1e-8, 1.3e-3, 4e-3])
def test_nearly_rigid_rotations_are_orthonormalised(error: float) -> None:
    rng = np.random.default_rng(0)
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    nearly = rotation + rng.uniform(-error / 2, error / 2, (3, 3))
    alignment = Alignment(nearly, [0, 0, 4], [1, 1, 1])
    made = alignment.rotation
    np.testing.assert_allclose(made @ made.T, np.eye(3), atol=1e-12)
    assert np.abs(made - rotation).max() <= 2 * error
    motion = np.eye(4)
    motion[:3, :3] = nearly
    view = View(
        Camera(640, 480, 900, 900, 319.5, 239.5),
        [[300, 200], [320, 220], [350, 240]],
        ids=[0, 1, 2],
        cam_from_rig=motion,
    )
    np.testing.assert_array_equal(view.cam_from_rig[:3, :3], made)


NOT_A_ROTATION = "not a rotation matrix; its rows must be orthonormal and its determinant +1"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((np.eye(3), [0, 0], [1, 1, 1]), "translation: shape (2,), expected (3)"),
        ((np.eye(3), [0, 0, 0], [[1, 1, 1]]), "scale: shape (1, 3), expected (3)"),
        ((np.diag([1, 1, -1]), [0, 0, 0], [1, 1, 1]), f"rotation: {NOT_A_ROTATION}"),
        ((1.01 * np.eye(3), [0, 0, 0], [1, 1, 1]), f"rotation: {NOT_A_ROTATION}"),
        (
            (np.eye(3), [0, np.nan, 0], [1, 1, 1]),
            "translation: NaN or infinite values in row 1; remove or repair these",
        ),
        ((np.eye(3), [0, 0, 0], [1, 0, 1]), "scale: [1.0, 0.0, 1.0] is not positive"),
    ],
)
def test_alignment_refuses_wrong_values(arguments: tuple[Any, ...], text: str) -> None:
    with pytest.raises(InputError) as caught:
        Alignment(*arguments)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ({"rotation": np.eye(3).tolist()}, "translation: missing"),
        ("text", "expected an object, got str"),
        (None, "expected an object, got NoneType"),
    ],
)
def test_from_dict_refuses_malformed_alignments(data: Any, text: str) -> None:
    with pytest.raises(InputError) as caught:
        Alignment.from_dict(data)
    assert str(caught.value) == text
