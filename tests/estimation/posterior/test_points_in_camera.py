"""Covariances of keypoints in the camera: propagated, and calibrated on unseen objects."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Model, Result, ShapeModel, View, align
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.render import look_at

DATA = Path(os.environ.get("CADALIGN_DATA", "/nonexistent")) / "keypointnet"
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


@pytest.mark.long
@pytest.mark.skipif(not DATA.is_dir(), reason="CADALIGN_DATA has no KeypointNet")
@pytest.mark.xfail(
    strict=True,
    reason="these chairs are nearer to the others than those that deviations are calibrated on, "
    "and the 95 % regions hold 98.6 %",
)
def test_regions_hold_unseen_keypoints_of_unseen_chairs() -> None:
    dataset = KeypointNet(DATA)
    shape = ShapeModel.from_dataset(dataset, "chair", split="train", meshes=False, components=4)
    shares = []
    for row, model in enumerate(dataset.subset(categories=["chair"], split="val")["chair"]):
        rng = np.random.default_rng(row)
        pose = look_at(azimuth=rng.uniform(0, 360), elevation=rng.uniform(0, 60), distance=2.0)
        ids = model.keypoints.ids.tolist()
        pixels = KEYPOINT_CAMERA.project(pose.apply(model.keypoints.xyz))
        seen = rng.permutation(len(ids))[:6]
        noisy = pixels[seen] + 2 * rng.standard_normal((len(seen), 2))
        view = View(KEYPOINT_CAMERA, noisy, ids=[ids[k] for k in seen], sigma=2.0)
        result = align(shape, view)
        rows = shape.rows(ids)
        in_camera = result.alignment.apply(result.points_3d[rows])
        own = result.points_cam_covariance[rows]
        covariances = KEYPOINT_CAMERA.projected_covariances(in_camera, own)
        error = KEYPOINT_CAMERA.project(in_camera) - pixels
        found = np.einsum("na,nab,nb->n", error, np.linalg.inv(covariances), error)
        shares.extend(np.delete(found, seen) / result.radius(0.95, dimension=2) ** 2)
    held = np.mean(np.array(shares) < 1)
    assert 0.90 <= held <= 0.98
