"""Doubts about implausible cameras."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import Alignment, Camera, Model, View, align, fit
from cadalign.evaluation.simulation import simulate_problem
from cadalign.geometry.calibration import camera_doubts
from cadalign.geometry.rotations import rotation_from_vector

RIGHT = Camera(640, 480, 935, 935, 319.5, 239.5)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (Camera(640, 480, 1870, 1870, 639.5, 479.5), "the middle of an image of 1280 x 960 px"),
        (Camera(640, 480, 935, 935, 0, 0), "(0, 0) is far from the middle"),
        (Camera(640, 480, 935, 701, 319.5, 239.5), "oblong (fx 935, fy 701)"),
        (Camera(640, 480, 35, 35, 319.5, 239.5), "is the focal length, 35, in pixels?"),
    ],
    ids=["larger image", "corner", "oblong", "millimetres"],
)
def test_implausible_cameras_are_doubted(camera: Camera, words: str) -> None:
    (doubt,) = camera_doubts(camera)
    assert words in doubt
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (20, 3))
    pose = Alignment(rotation_from_vector(rng.normal(0, 1.5, 3)), [0, 0, 2.0], [1, 1.1, 0.9])
    pixels = RIGHT.project(pose.apply(points)) + rng.normal(0, 1, (20, 2))
    model = Model(points_3d=points, shape_sigma=0.03)
    for result in (fit(points, pixels, camera), align(model, View(camera, pixels))):
        assert (result.warnings[0].kind, result.warnings[0].text) == ("camera", doubt)


@pytest.mark.parametrize(
    "camera",
    [
        RIGHT,
        RIGHT.crop(100, 50, 480, 360),
        Camera(640, 480, 520, 519, 325, 253),
        Camera(640, 480, 200, 200, 319.5, 239.5, distortion=(0.1, 0, 0, 0), lens="fisheye"),
        Camera.from_size(640, 480),
    ],
    ids=["usual", "part of a photo", "calibrated", "fisheye", "unknown"],
)
def test_plausible_cameras_are_not_doubted(camera: Camera) -> None:
    assert camera_doubts(camera) == ()


def test_consistent_keypoints_confirm_a_wide_camera() -> None:
    problem = simulate_problem(np.random.default_rng(1), points=10, noise_px=1.0)
    assert len(camera_doubts(problem.camera)) == 1
    assert fit(problem.points_3d, problem.points_2d, problem.camera).warnings == ()
