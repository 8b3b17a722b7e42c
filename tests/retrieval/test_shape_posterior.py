"""`shape_posterior`: the joint posterior of all keypoints and the box."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import Alignment, Camera, Model, ShapeModel, View, align
from cadalign.errors import InputError
from cadalign.retrieval.shape_posterior import gaussians_of, shape_posterior

CAMERA = Camera(width=640, height=480, fx=900.0, fy=900.0, cx=319.5, cy=239.5)
LENS = Camera(640, 480, 900.0, 880.0, 319.5, 239.5, (-0.1, 0.03, 0.001, -0.002))
POSE = Alignment(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.05, 5.0]), np.ones(3))
MEAN = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 3))


def make_shape(residual_sigma: float = 0.0, modes: int = 4) -> ShapeModel:
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((modes, 9, 3))
    box = [MEAN.min(axis=0), MEAN.max(axis=0)]
    return ShapeModel.from_basis(
        MEAN, directions, np.full(modes, 0.05), box=box, residual_sigma=residual_sigma
    )


def make_view(camera: Camera = CAMERA, count: int = 7) -> View:
    rng = np.random.default_rng(2)
    points = MEAN + 0.03 * rng.standard_normal(MEAN.shape)
    sigma = rng.uniform(0.5, 3, count)
    pixels = camera.project(POSE.apply(points))[:count]
    pixels += sigma[:, None] * rng.standard_normal(pixels.shape)
    return View(camera, pixels, ids=range(count), sigma=sigma)


@pytest.mark.parametrize("camera", [CAMERA, LENS])
@pytest.mark.parametrize("residual_sigma", [0.0, 0.02])
def test_agrees_with_the_alignment_of_one_gaussian(camera: Camera, residual_sigma: float) -> None:
    view, shape = make_view(camera), make_shape(residual_sigma)
    result = align(shape, view)
    assert not result.alternatives
    found = shape_posterior(result, view).shapes
    assert found.weights.tolist() == [1.0]
    means = found.means.reshape(-1, 3)
    np.testing.assert_allclose(means[:-2], result.points_3d, atol=2e-5)
    # The box of an alignment is widened to hold the keypoints that are seen.
    given = result.points_3d[:7]
    box = [np.minimum(means[-2], given.min(axis=0)), np.maximum(means[-1], given.max(axis=0))]
    np.testing.assert_allclose(box, result.bounds, atol=2e-5)
    blocks = found.covariances.reshape(11, 3, 11, 3)[np.arange(9), :, np.arange(9)]
    scale = result.points_covariance.max()
    np.testing.assert_allclose(blocks, result.points_covariance, atol=1e-4 * scale)


def test_without_information_it_is_the_prior() -> None:
    shape = make_shape(0.01)
    view = View(CAMERA, make_view().points_2d, ids=range(7), sigma=1e5)
    found = shape_posterior(align(shape, view), view).shapes
    np.testing.assert_allclose(found.covariances, gaussians_of(shape).covariances, atol=1e-6)


def test_more_keypoints_leave_less_open() -> None:
    shape = make_shape(0.01)
    volumes = []
    for count in (5, 7, 9):
        view = make_view(count=count)
        found = shape_posterior(align(shape, view), view).shapes
        volumes.append(np.linalg.slogdet(found.covariances[0])[1])
    assert volumes == sorted(volumes, reverse=True)


def test_evidence_prefers_the_category_of_the_object() -> None:
    shape, view = make_shape(0.01), make_view()
    rng = np.random.default_rng(5)
    other = ShapeModel.from_basis(
        rng.uniform(-0.5, 0.5, (9, 3)), rng.standard_normal((4, 9, 3)), np.full(4, 0.05)
    )
    own = shape_posterior(align(shape, view), view).log_evidence
    assert own > shape_posterior(align(other, view), view).log_evidence + 10


def test_an_exact_model_has_no_shape_posterior() -> None:
    view = make_view()
    with pytest.raises(InputError, match="expected the alignment of a shape model with one view"):
        shape_posterior(align(Model(points_3d=MEAN), view), view)
