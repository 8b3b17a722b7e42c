"""Warnings about problems that deviations do not show; correct problems rarely have one."""

from __future__ import annotations

import re

import numpy as np
from support.problems import problem_of

from cadalign import Alignment, Camera, Model, Result, View, align, fit
from cadalign.estimation.result_parts import Warnings
from cadalign.estimation.uncertainty.doubts import pose_doubts
from cadalign.geometry.rotations import angles_between, rotation_from_vector

CAMERA = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
POSE = Alignment(np.eye(3), [0.0, 0.0, 4.0], np.ones(3))


def with_other(angle_deg: float, share: float, own_deg: float = 2.0) -> Warnings:
    """Warnings about a second pose with a share of the probability, from the moments of both."""
    turn = np.radians([angle_deg, 0.0, 0.0])
    other = Alignment(rotation_from_vector(turn), POSE.translation, np.ones(3))
    covariance = np.zeros((9, 9))
    covariance[:3, :3] = np.radians(own_deg) ** 2 * np.eye(3) + share * np.outer(turn, turn)
    return pose_doubts(POSE, [(other, share / (1 - share))], covariance)


def test_a_warning_prints_as_its_text_and_is_stored_with_its_kind() -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (12, 3))
    pixels = CAMERA.project(POSE.apply(points))
    pixels[3] += 40
    result = fit(points, pixels, CAMERA, sigma=1.0)
    (found,) = result.warnings
    assert (found.kind, found.view, found.keypoints) == ("outlier", 0, (3,))
    assert str(result).endswith(f"  warning      {found}")
    assert repr(result.warnings) == repr((found.text,))
    written = {"kind": "outlier", "text": found.text, "view": 0, "keypoints": [3]}
    assert result.to_dict()["warnings"] == [written]
    assert Result.from_dict(result.to_dict()).warnings == (found,)


def test_another_pose_is_named_where_the_deviations_conceal_it() -> None:
    (found,) = with_other(170, 0.1)
    assert found.text.startswith("another pose, 170 deg away, has a probability of 10 %")
    assert not with_other(170, 0.03)  # less than what the 95 % interval leaves
    assert not with_other(90, 0.4)  # the deviations reach that far
    assert not with_other(6, 0.1)
    assert with_other(170, 0.5)  # deviations that leave all rotations open say nothing of two


def test_poses_that_are_concealed_together_are_one_warning() -> None:
    covariance = np.zeros((9, 9))
    covariance[:3, :3] = np.radians(20) ** 2 * np.eye(3)
    turns = [[170, 0, 0], [0, 160, 0]]
    poses = [
        Alignment(rotation_from_vector(np.radians(turn)), POSE.translation, np.ones(3))
        for turn in turns
    ]
    (found,) = pose_doubts(POSE, [(poses[0], 0.04), (poses[1], 0.04)], covariance)
    assert found.text.startswith("other poses, the likeliest 1")
    assert "7 %" in found.text


def test_keypoints_beyond_their_sigma_are_warned_of_beside_other_evidence() -> None:
    """Residuals are stated if no evidence contradicts the rest, but not at the correct sigma."""
    for noise, sigma in ((4.0, 1.0), (1.0, 1.0), (4.0, 4.0)):
        problem = problem_of(4, points=14, noise_px=noise)
        up = problem.alignment.rotation[:, 1]
        view = View(problem.camera, problem.points_2d, sigma=sigma, up=up, up_sigma_deg=1.0)
        told = align(Model(points_3d=problem.points_3d), view).warnings
        found = [each for each in told if re.search(r"residuals are \S+ times", each.text)]
        assert [each.kind for each in found] == ["misfit"] * (noise > sigma)


def test_fit_names_another_pose_that_its_deviations_do_not_reach() -> None:
    named = 0
    for seed in range(20):
        problem = problem_of(seed, points=4, noise_px=0.0)
        result = fit(problem.points_3d, problem.points_2d, problem.camera, sigma=0.05)
        angles = [
            angles_between(each.alignment.rotation, result.alignment.rotation)
            for each in result.alternatives
        ]
        assert result.std is not None
        if any(angle > max(30, 5 * result.std.rotation_deg) for angle in angles):
            assert any(each.kind == "alternative" for each in result.warnings)
            named += 1
    assert named > 3


def test_similar_models_of_right_size_have_no_warning() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.5, 0.5, (12, 3))
    truth = Alignment(rotation_from_vector(rng.normal(size=3)), [0.0, 0.0, 3.0], np.ones(3))
    pixels = CAMERA.project(truth.apply(points + rng.normal(0, 0.02, points.shape)))
    model = Model(points_3d=points, shape_sigma=0.02)
    assert align(model, View(CAMERA, pixels, sigma=1.0)).warnings == ()
