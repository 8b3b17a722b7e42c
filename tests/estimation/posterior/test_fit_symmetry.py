"""Fits of symmetric models: one canonical result for all labellings of the keypoints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cadalign import (
    Alignment,
    Camera,
    Model,
    RansacOptions,
    Symmetry,
    View,
    align,
    fit,
    fit_batch,
)
from cadalign.errors import DegenerateError
from cadalign.geometry.rotations import angles_between, rotation_from_vector
from cadalign.geometry.symmetry import FACING

UP = np.array([0.0, 1.0, 0.0])
CAMERA = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
OFFSET = np.array([0.05, 0.0, -0.08])
FOLDS = (2, 3, 4, 6, None)


def ring(count):
    """Keypoints of a tiered ring about the upright axis through the offset, (3 count, 3)."""
    angles = 2 * np.pi * np.arange(count) / count
    circle = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    tiers = [(0.5, -0.4), (0.35, 0.1), (0.2, 0.5)]
    return np.concatenate([circle * radius + UP * height + OFFSET for radius, height in tiers])


def truth_of(angle, scale=(1.0, 1.3, 1.0)):
    tilted = FACING @ rotation_from_vector(np.array([0.4, 0.0, 0.1]))
    return Alignment(tilted @ rotation_from_vector(angle * UP), [0.1, -0.2, 6.0], np.array(scale))


def observed(angle, *, fold, noise_px=0.5, scale=(1.0, 1.3, 1.0)):
    """Model points (12 or 18 of them) and their pixels."""
    points = ring(fold or 5)
    noise = np.random.default_rng(3).normal(0, noise_px, (len(points), 2))
    return points, CAMERA.project(truth_of(angle, scale).apply(points)) + noise


def labelled_after(points, angle):
    """The same points, relabelled by a rotation about the axis."""
    return (points - OFFSET) @ rotation_from_vector(angle * UP).T + OFFSET


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(FOLDS), st.integers(1, 11), st.floats(-3, 3))
def test_permuted_labels_give_the_same_result(fold, step, angle):
    symmetry = Symmetry.around(UP, fold=fold, offset=OFFSET)
    points, pixels = observed(angle, fold=fold)
    turn = 2 * np.pi * step / (fold or 12)
    first = fit(points, pixels, CAMERA, stretch="y", symmetry=symmetry)
    second = fit(labelled_after(points, turn), pixels, CAMERA, stretch="y", symmetry=symmetry)
    assert angles_between(first.alignment.rotation, second.alignment.rotation) < 1e-3
    np.testing.assert_allclose(first.alignment.translation, second.alignment.translation, atol=1e-5)
    np.testing.assert_allclose(first.alignment.scale, second.alignment.scale, atol=1e-5)
    np.testing.assert_allclose(first.points_3d, second.points_3d, atol=1e-4)
    np.testing.assert_allclose(
        first.fisher_covariance, second.fisher_covariance, rtol=1e-2, atol=1e-9
    )


@pytest.mark.parametrize("fold", [3, 4, None])
def test_it_is_the_fit_of_keypoints_labelled_as_it_says(fold):
    """Alignment, residuals and covariance belong to ``points_3d``, and so do the deviations."""
    symmetry = Symmetry.around(UP, fold=fold, offset=OFFSET)
    points, pixels = observed(2.0, fold=fold)
    result = fit(points, pixels, CAMERA, stretch="y", symmetry=symmetry)
    seen = CAMERA.project(result.alignment.apply(result.points_3d))
    np.testing.assert_allclose(seen - pixels, result.residuals, atol=1e-7)
    plain = fit(result.points_3d, pixels, CAMERA, stretch="y")
    np.testing.assert_allclose(plain.alignment.rotation, result.alignment.rotation, atol=1e-6)
    np.testing.assert_allclose(
        plain.fisher_covariance, result.fisher_covariance, rtol=1e-3, atol=1e-10
    )
    if fold is not None:
        assert result.std.rotation_deg == pytest.approx(plain.std.rotation_deg, rel=0.02)
        # It looks at the camera within half a step.
        assert angles_between(result.alignment.rotation, truth_of(0).rotation) <= 180 / fold + 1


def test_rotations_about_the_axis_count_for_nothing():
    """Deviations concern the axis only; a bottle's rotation about it has none."""
    symmetry = Symmetry.around(UP, fold=None, offset=OFFSET)
    points, pixels = observed(1.0, fold=None)
    slim = (points - OFFSET) * [0.015, 1, 0.015] + OFFSET  # its rotation is hardly seen
    pixels = CAMERA.project(truth_of(1.0).apply(slim))
    options = {"stretch": "none", "sigma": 2.0}
    plain = fit(slim, pixels, CAMERA, **options)
    result = fit(slim, pixels, CAMERA, **options, symmetry=symmetry)
    assert plain.std.rotation_deg > 30
    assert "rotation" in plain.uncertain
    assert result.std.rotation_deg < 0.5 * plain.std.rotation_deg
    assert "rotation" not in result.uncertain
    # The deviation of the axis' direction stays.
    axis = plain.alignment.rotation @ UP
    across = np.eye(3) - np.outer(axis, axis)
    deviation = np.sqrt(np.trace(across @ plain.covariance[:3, :3] @ across))
    assert result.std.rotation_deg == pytest.approx(np.degrees(deviation), rel=0.1)


def test_a_stretch_across_the_axis_leaves_half_turns():
    symmetry = Symmetry.around(UP, fold=4, offset=OFFSET)
    points, pixels = observed(0.2, fold=4, scale=(1.0, 1.3, 1.6))
    results = [
        fit(labelled_after(points, step * np.pi), pixels, CAMERA, symmetry=symmetry)
        for step in range(2)
    ]
    for result in results:
        np.testing.assert_allclose(result.alignment.scale, (1, 1.3, 1.6), rtol=0.02)
        assert angles_between(result.alignment.rotation, truth_of(0.2).rotation) < 1


def test_an_equal_minimum_is_no_alternative():
    """Four corners of a square, which a turn explains as well."""
    symmetry = Symmetry.around(UP, fold=2)
    flat = np.array([[x, y, 0.0] for x in (-1, 0, 1) for y in (-1, 1)])
    # In the plane of the axis, a half turn mirrors the points.
    pixels = CAMERA.project(Alignment(FACING, [0, 0, 900.0], np.ones(3)).apply(flat))
    plain = fit(flat, pixels, CAMERA, stretch="none")
    merged = fit(flat, pixels, CAMERA, stretch="none", symmetry=symmetry)
    for other in merged.alternatives:
        near = merged.alignment.rotation, other.alignment.rotation
        assert angles_between(*near) > 0.01
    assert len(merged.alternatives) <= len(plain.alternatives)


def test_a_batch_is_as_single_fits():
    symmetry = Symmetry.around(UP, fold=3, offset=OFFSET)
    problems = [observed(angle, fold=3) for angle in (0.0, 1.0, 4.0)]
    singles = [fit(*each, CAMERA, stretch="y", symmetry=symmetry) for each in problems]
    for workers in (1, 2):
        batch = fit_batch(
            *map(list, zip(*problems, strict=True)),
            CAMERA,
            stretch="y",
            symmetry=symmetry,
            workers=workers,
        )
        for b, single in enumerate(singles):
            assert (batch.rotation[b] == single.alignment.rotation).all()
            assert (batch.translation[b] == single.alignment.translation).all()
            assert (batch[b].fisher_covariance == single.fisher_covariance).all()


def test_with_outliers_and_an_unknown_focal_length():
    symmetry = Symmetry.around(UP, fold=6, offset=OFFSET)
    points, pixels = observed(3.0, fold=6, noise_px=0.2)
    wrong = pixels.copy()
    wrong[:3] += 60
    robust = fit(points, wrong, CAMERA, stretch="y", symmetry=symmetry, ransac=RansacOptions())
    assert robust.inliers.sum() == len(points) - 3
    seen = CAMERA.project(robust.alignment.apply(robust.points_3d))
    np.testing.assert_allclose(seen - wrong, robust.residuals, atol=1e-6)
    unknown = fit(points, pixels, Camera.from_size(640, 480), focal="estimate",
                  stretch="y", symmetry=symmetry)  # fmt: skip
    again = fit(unknown.points_3d, pixels, Camera.from_size(640, 480), focal="estimate",
                stretch="y")  # fmt: skip
    np.testing.assert_allclose(
        unknown.fisher_covariance, again.fisher_covariance, rtol=1e-2, atol=1e-8
    )


@pytest.mark.parametrize("options", [{}, {"stretch": "none"}, {"stretch_sigma": 0.2}])
def test_keypoints_on_the_axis_alone_are_refused(options):
    points = OFFSET + UP * np.linspace(-0.4, 0.5, 4)[:, None]
    seen = CAMERA.project(truth_of(0.3).apply(points))
    symmetry = Symmetry.around(UP, fold=None, offset=OFFSET)
    expected = (
        "points_3d: the rotation is not determined: the points lie on one line; add keypoints"
    )
    with pytest.raises(DegenerateError) as single:
        fit(points, seen, CAMERA, symmetry=symmetry, **options)
    with pytest.raises(DegenerateError) as joint:
        align(Model(points_3d=points, symmetry=symmetry, **options), View(CAMERA, seen))
    for refused in (single, joint):
        assert str(refused.value).startswith(expected)


def test_keypoints_off_the_axis_beside_those_on_it_are_enough():
    points = np.vstack([OFFSET + UP * np.linspace(-0.4, 0.5, 5)[:, None], ring(5)[:3]])
    seen = CAMERA.project(truth_of(0.3, scale=(1, 1, 1)).apply(points))
    symmetry = Symmetry.around(UP, fold=None, offset=OFFSET)
    result = fit(points, seen, CAMERA, symmetry=symmetry, stretch="none")
    assert result.rms < 1e-3
