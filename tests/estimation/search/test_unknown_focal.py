"""Unknown focal lengths, noise and starts with every model and in every number of views."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign import (
    Alignment,
    Camera,
    FocalPrior,
    Model,
    RansacOptions,
    Result,
    ShapeModel,
    Size,
    View,
    align,
    align_batch,
    fit,
)
from cadalign.errors import InputError
from cadalign.metrics import rotation_error

POINTS = 14
FOCAL = 900.0
TRUE = Camera(640, 480, FOCAL, FOCAL, 319.5, 239.5)
UNKNOWN = Camera.without_focal(640, 480)
MEAN = np.random.default_rng(0).uniform(-0.3, 0.3, (POINTS, 3))
MODES = 0.1 * np.random.default_rng(1).normal(size=(3, POINTS, 3))


def models() -> dict[str, tuple[Model | ShapeModel, np.ndarray]]:
    """A model of each kind, and the keypoints of an object of that kind."""
    rng = np.random.default_rng(2)
    learned = ShapeModel.from_basis(MEAN, MODES, np.ones(3), residual_sigma=0.005)
    varied = MEAN + np.tensordot([0.5, -1.0, 0.3], MODES, 1)
    return {
        "exact": (Model(points_3d=MEAN), MEAN),
        "similar": (
            Model(points_3d=MEAN, shape_sigma=0.01),
            MEAN + rng.normal(0, 0.01, MEAN.shape),
        ),
        "learned": (learned, varied + rng.normal(0, 0.005, MEAN.shape)),
    }


def poses(count: int) -> list[Alignment]:
    turns = Rotation.from_rotvec([[0.3, 0.4 * k, 0.1] for k in range(count)])
    return [
        Alignment(turn.as_matrix(), [0.05, 0.02 * k, 1.3], np.ones(3))
        for k, turn in enumerate(turns)
    ]


def photos(points: np.ndarray, count: int, *, px: float = 0.5) -> list[np.ndarray]:
    rng = np.random.default_rng(count)
    return [
        TRUE.project(pose.apply(points)) + rng.normal(0, px, (len(points), 2))
        for pose in poses(count)
    ]


@pytest.mark.parametrize("kind", ["exact", "similar", "learned"])
@pytest.mark.parametrize("count", [1, 3])
def test_the_focal_length_is_found(kind: str, count: int) -> None:
    model, points = models()[kind]
    views = [View(UNKNOWN, photo, sigma=0.5) for photo in photos(points, count)]
    result = align(model, views, focal="estimate")
    assert result.focal == "estimate"
    assert len({camera.fx for camera in result.cameras}) == 1
    assert result.covariance is not None
    assert result.covariance.shape == (10, 10)
    assert result.std is not None
    assert result.std.focal == pytest.approx(np.sqrt(result.covariance[9, 9]))
    assert abs(np.log(result.camera.fx / FOCAL)) < 4 * result.std.focal < 0.8
    for found, true in zip(result.poses, poses(count), strict=True):
        assert rotation_error(est=found, gt=true) < 5


def test_views_of_other_cameras_have_focal_lengths_of_their_own() -> None:
    model, points = models()["learned"]
    wide = Camera(800, 600, 700.0, 700.0, 399.5, 299.5)
    first, second = poses(2)
    views = [
        View(UNKNOWN, TRUE.project(first.apply(points)), sigma=0.2),
        View(Camera.without_focal(800, 600), wide.project(second.apply(points)), sigma=0.2),
    ]
    result = align(model, views, focal="estimate")
    assert abs(result.cameras[0].fx / FOCAL - 1) < 0.1
    assert abs(result.cameras[1].fx / 700 - 1) < 0.1


def test_a_prior_sharpens_the_focal_length() -> None:
    model, points = models()["learned"]
    view = View(UNKNOWN, photos(points, 1)[0], sigma=0.5)
    free = align(model, view, focal="estimate")
    known = align(model, view, focal="estimate", focal_prior=FocalPrior(FOCAL, 0.002))
    assert free.std is not None
    assert known.std is not None
    assert known.std.focal <= 0.002 < free.std.focal
    assert known.std.rotation_deg <= free.std.rotation_deg
    (one,) = align_batch(model, [view], focal="estimate", focal_prior=FocalPrior(FOCAL, 0.002))
    assert isinstance(one, Result)
    assert one.camera == known.camera


def test_outliers_depth_gravity_and_a_length_go_with_it() -> None:
    model, points = models()["learned"]
    (pose,), (photo,) = poses(1), photos(points, 1)
    depths = pose.apply(points)[:, 2]
    up = pose.rotation[:, 1]
    everything = View(UNKNOWN, photo, sigma=0.5, depth=depths, up=up)
    width = float(np.ptp(points[:, 0]))
    result = align(Model(points_3d=points), everything, size=Size(width=width), focal="estimate")
    assert abs(result.camera.fx / FOCAL - 1) < 0.05
    moved = photo.copy()
    moved[[2, 9]] += [80.0, -60.0]
    robust = align(model, View(UNKNOWN, moved, sigma=0.5), focal="estimate", ransac=RansacOptions())
    assert np.flatnonzero(~robust.inliers).tolist() == [2, 9]
    assert abs(robust.camera.fx / FOCAL - 1) < 0.2


def test_fit_and_align_agree_about_an_exact_model() -> None:
    (photo,) = photos(MEAN, 1)
    one = fit(MEAN, photo, UNKNOWN, sigma=0.5, focal="estimate")
    other = align(Model(points_3d=MEAN), View(UNKNOWN, photo, sigma=0.5), focal="estimate")
    assert one.camera == other.camera
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert one.warnings == other.warnings


@pytest.mark.parametrize("kind", ["similar", "learned"])
@pytest.mark.parametrize("count", [1, 3])
def test_noise_that_is_not_given_is_estimated(kind: str, count: int) -> None:
    model, points = models()[kind]
    views = [View(TRUE, photo, sigma=None) for photo in photos(points, count, px=3.0)]
    result = align(model, views)
    assert result.sigma is not None
    assert 1.0 < result.sigma < 6.0
    assert result.std is not None
    told = align(model, [View(TRUE, view.points_2d, sigma=3.0) for view in views]).std
    assert told is not None
    assert 0.3 < result.std.rotation_deg / told.rotation_deg < 3


def test_every_view_may_have_a_start() -> None:
    model, points = models()["exact"]
    truths, seen = poses(2), photos(points, 2)
    views = [View(TRUE, photo, sigma=0.5) for photo in seen]
    result = align(model, views, init=[None, truths[1]])
    assert rotation_error(est=result.poses[1], gt=truths[1]) < 1
    with pytest.raises(InputError, match="init: 1 for 2 views"):
        align(model, views, init=[truths[0]])
    with pytest.raises(InputError, match=r"init\[1\]: expected a cadalign.Alignment or None"):
        align(model, views, init=[None, 3])  # type: ignore[list-item]


@pytest.mark.parametrize("minimal", ["ap4p", "aepnp"])
def test_samples_follow_confidences(minimal: str) -> None:
    model, points = models()["learned"]
    (photo,) = photos(points, 1)
    moved = photo.copy()
    wrong = [0, 3, 5, 8, 11]
    moved[wrong] += np.random.default_rng(0).uniform(60, 120, (5, 2))
    scores = np.where(np.isin(np.arange(POINTS), wrong), 0.1, 0.9)
    view = View(TRUE, moved, sigma=0.5, scores=scores)
    result = align(model, view, ransac=RansacOptions(minimal=minimal))
    assert np.flatnonzero(~result.inliers).tolist() == wrong
