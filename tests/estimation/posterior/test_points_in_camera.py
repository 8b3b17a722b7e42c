"""Covariances of keypoints in the camera: propagated, and calibrated on unseen objects."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Model, Result, View, align

CAMERA = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
TRUTH = Alignment(Rotation.from_rotvec([2.5, 0.4, -0.3]).as_matrix(), [0.3, 0.2, 6.0], np.ones(3))


def photo_of(points: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).standard_normal((len(points), 2))
    return np.asarray(CAMERA.project(TRUTH.apply(points)) + noise)


def test_those_of_a_stretched_model_follow_from_its_covariance() -> None:
    result = align(Model(points_3d=CORNERS), View(CAMERA, photo_of(CORNERS * [1, 1.2, 0.9])))
    pose = result.alignment

    def moved(step: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        scale = pose.scale * np.exp(step[6:])
        return Alignment(turn @ pose.rotation, pose.translation + step[3:6], scale).apply(CORNERS)

    slopes = np.stack([(moved(s) - moved(-s)) / 2e-6 for s in 1e-6 * np.eye(9)], axis=-1)
    expected = slopes @ result.covariance @ slopes.swapaxes(1, 2)
    np.testing.assert_allclose(result.points_cam_covariance, expected, rtol=1e-5, atol=1e-9)


def test_keypoints_that_are_seen_are_better_known_than_the_rest() -> None:
    model = Model(points_3d=CORNERS, shape_sigma=0.05)
    result = align(model, View(CAMERA, photo_of(CORNERS)[:6], ids=range(6)))
    in_camera = result.alignment.apply(result.points_3d)
    covariances = CAMERA.projected_covariances(in_camera, result.points_cam_covariance)
    deviations = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    assert (deviations[:6] < 1.5).all()
    assert (deviations[6:] > 3).all()


def test_they_are_read_as_they_were_written() -> None:
    model = Model(points_3d=CORNERS, shape_sigma=0.05)
    result = align(model, View(CAMERA, photo_of(CORNERS)))
    again = Result.from_dict(result.to_dict())
    assert (again.points_cam_covariance == result.points_cam_covariance).all()
