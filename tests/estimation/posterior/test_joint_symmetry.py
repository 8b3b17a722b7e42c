"""`align` of symmetric models: one canonical result, in every view, with the object's points."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import Alignment, Camera, Model, Result, Size, Symmetry, View, align
from cadalign.geometry.rotations import angles_between, rotation_from_vector
from cadalign.geometry.symmetry import FACING

UP = np.array([0.0, 1.0, 0.0])
CAMERA = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
CORNERS = np.array([[x, y, z] for y in (-0.5, 0.1, 0.6) for x in (-1, 1) for z in (-1, 1)], float)
CORNERS[4:8] *= [0.6, 1, 0.6]
FOUR = Symmetry.around(UP, fold=4)
QUARTER = rotation_from_vector(np.pi / 2 * UP).round()
LEFT, RIGHT = (
    Alignment(rotation_from_vector(angle * UP), [shift, 0, 0.2], np.ones(3))
    for angle, shift in ((0.0, 0.0), (-0.3, 1.4))
)


def truth_of(scale, *, angle=0.3):
    tilted = FACING @ rotation_from_vector(np.array([0.4, 0.0, 0.1]))
    return Alignment(tilted @ rotation_from_vector(angle * UP), [0.1, -0.2, 7.0], np.array(scale))


def pixels_of(truth, camera_pose=None, *, points=CORNERS):
    in_rig = truth.apply(points)
    seen = in_rig if camera_pose is None else camera_pose.apply(in_rig)
    return CAMERA.project(seen) + np.random.default_rng(5).normal(0, 0.3, (len(points), 2))


def models(**options):
    """The model, and a copy relabelled by a quarter turn."""
    turned = CORNERS @ QUARTER.T
    return [Model(points_3d=each, symmetry=FOUR, **options) for each in (CORNERS, turned)]


def assert_same(first, second, *, tolerance):
    assert angles_between(first.alignment.rotation, second.alignment.rotation) < 50 * tolerance
    for name in ("points_3d", "bounds", "stretch"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), atol=tolerance)
    np.testing.assert_allclose(
        first.alignment.translation, second.alignment.translation, atol=20 * tolerance
    )
    np.testing.assert_allclose(first.covariance, second.covariance, rtol=0.05, atol=1e-7)
    np.testing.assert_allclose(
        first.points_covariance, second.points_covariance, rtol=0.1, atol=1e-6
    )
    for k in range(len(first.poses)):
        np.testing.assert_allclose(
            first.poses[k].apply(first.points_3d), second.poses[k].apply(second.points_3d),
            atol=20 * tolerance,
        )  # fmt: skip


@pytest.mark.parametrize("options", [{"stretch": "y"}, {"stretch": "y", "shape_sigma": 0.03}])
def test_labels_that_are_turned_give_the_same_result(options):
    truth = truth_of((1, 1.3, 1))
    view = View(CAMERA, pixels_of(truth), sigma=0.3)
    first, second = (align(model, view) for model in models(**options))
    assert_same(first, second, tolerance=2e-4)
    assert angles_between(first.alignment.rotation, truth.rotation) < 1
    for result in (first, second):
        seen = CAMERA.project(result.alignment.apply(result.points_3d))
        np.testing.assert_allclose(seen - view.points_2d, result.residuals, atol=1e-6)
        assert str(Result.from_dict(result.to_dict())) == str(result)


def test_with_its_size_known_a_quarter_turn_exchanges_stretches():
    """The object is long along z, or along x of the relabelled model."""
    truth = truth_of((1, 1.3, 1.6))
    view = View(CAMERA, pixels_of(truth), sigma=0.3)
    sized = [align(model, view, size=Size(height=1.1 * 1.3, sigma=0.001)) for model in models()]
    assert_same(*sized, tolerance=5e-4)
    np.testing.assert_allclose(sized[1].stretch, (1, 1.3, 1.6), rtol=0.02)
    held = [align(model, view) for model in models()]
    np.testing.assert_allclose(held[0].stretch, (1, 1.3, 1.6), rtol=0.02)
    np.testing.assert_allclose(held[1].stretch, (1, 1.3 / 1.6, 1 / 1.6), rtol=0.02)


@pytest.mark.parametrize("known", [True, False])
def test_the_motion_turns_every_view(known):
    truth = truth_of((1, 1.3, 1))
    views = [
        View(CAMERA, pixels_of(truth, pose), sigma=0.3,
             cam_from_rig=pose.cam_from_model if known else None)
        for pose in (LEFT, RIGHT)
    ]  # fmt: skip
    first, second = (align(model, views) for model in models(stretch="y"))
    assert_same(first, second, tolerance=5e-4)
    assert (second.rig_from_model is not None) == known
    for view, found, pose in zip(views, second.views, second.poses, strict=True):
        seen = CAMERA.project(pose.apply(second.points_3d))
        np.testing.assert_allclose(seen - view.points_2d, found.residuals, atol=1e-6)
        if known:
            in_view = view.cam_from_rig @ second.rig_from_model.cam_from_model
            np.testing.assert_allclose(in_view, pose.cam_from_model, atol=1e-9)


def test_of_a_round_model_rotations_about_its_axis_count_for_nothing():
    round_model = Symmetry.around(UP, fold=None)
    options = {"stretch": "y", "shape_sigma": 0.05}
    thin = CORNERS * [0.1, 1, 0.1]
    view = View(CAMERA, pixels_of(truth_of((1, 1.3, 1)), points=thin), sigma=1.0)
    plain = align(Model(points_3d=thin, **options), view)
    result = align(Model(points_3d=thin, **options, symmetry=round_model), view)
    assert plain.std.rotation_deg > 10
    axis = result.alignment.rotation @ UP
    across = np.eye(3) - np.outer(axis, axis)
    variance = np.trace(across @ plain.covariance[:3, :3] @ across)
    assert result.std.rotation_deg == pytest.approx(np.degrees(np.sqrt(variance)), rel=0.05)
    # Two tilts in different order differ by a turn about the axis.
    assert axis @ result.covariance[:3, :3] @ axis < 0.03 * variance
