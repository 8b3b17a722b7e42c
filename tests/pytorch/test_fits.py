"""`cadalign.torch.fit`: estimates, gradients, masks, failures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.problems import LENS, problem_of

import cadalign
from cadalign import Camera
from cadalign.errors import InputError

torch = pytest.importorskip("torch", reason='needs pip install -e ".[torch]"')
from cadalign.torch import fit  # noqa: E402

pytestmark = pytest.mark.slow
COUNT, POINTS = 40, 10


def tensors(count: int = COUNT, **options: Any) -> tuple[Any, Any, Camera]:
    """Model points (B, n, 3) and pixels (B, n, 2) of synthetic problems, and their camera."""
    problems = [problem_of(seed, points=POINTS, **options) for seed in range(count)]
    return (
        torch.tensor(np.array([each.points_3d for each in problems])),
        torch.tensor(np.array([each.points_2d for each in problems])),
        problems[0].camera,
    )


def test_results_equal_fit_batch() -> None:
    points, pixels, camera = tensors(12)
    found = fit(points, pixels, camera, sigma=0.5)
    expected = cadalign.fit_batch(points.numpy(), pixels.numpy(), camera, sigma=0.5)
    assert found.valid.all()
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-4)
    np.testing.assert_allclose(found.scale, expected.scale, rtol=1e-4)
    deviations = found.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (deviations[:, :6] > 0).all()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"loss": "cauchy"},
        {"loss": "huber"},
        {"stretch": "none"},
        {"stretch": "y", "stretch_sigma": 0.2},
    ],
    ids=str,
)
def test_gradcheck(options: dict[str, Any]) -> None:
    points, pixels, camera = tensors(3)
    sigma = torch.linspace(0.6, 1.4, POINTS, dtype=torch.float64).expand(3, POINTS).clone()

    def layer(*given: Any) -> tuple[Any, ...]:
        found = fit(given[0], given[1], camera, sigma=given[2], **options)
        return found.rotation, found.translation, found.scale

    inputs = [each.clone().requires_grad_() for each in (points, pixels, sigma)]
    assert torch.autograd.gradcheck(layer, inputs, eps=1e-5, atol=1e-7, rtol=1e-3, fast_mode=True)


def test_gradients_with_distortion_and_with_one_camera_per_problem() -> None:
    points, pixels, camera = tensors(4)
    wider = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
    found = fit(points, pixels, camera)
    seen = [wider.project(found_one.numpy()) for found_one in found.apply(points).detach()]
    lens = [LENS.project(each.numpy() * [1, 1, 3.0]) for each in found.apply(points).detach()]
    mixed = torch.tensor(np.array([seen[0], pixels[1].numpy(), lens[2], pixels[3].numpy()]))
    cameras = [wider, camera, LENS, camera]
    mixed += torch.randn(mixed.shape, generator=torch.Generator().manual_seed(0)) * 0.2
    one = fit(points, mixed, cameras)
    alone = fit(points[1:2], mixed[1:2], camera)
    np.testing.assert_allclose(one.rotation[1], alone.rotation[0], atol=1e-8)
    kept = [0, 1, 3]  # derivatives neglect a small term of the distortion

    def layer(given: Any) -> tuple[Any, ...]:
        found = fit(points[kept], given, [cameras[k] for k in kept])
        return found.rotation, found.translation

    given = mixed[kept].clone().requires_grad_()
    assert torch.autograd.gradcheck(layer, given, eps=1e-5, atol=1e-7, rtol=1e-3, fast_mode=True)


def test_masked_and_nan_keypoints_are_ignored() -> None:
    points, pixels, camera = tensors(6)
    mask = torch.ones(6, POINTS, dtype=torch.bool)
    mask[2, :3] = False
    spoiled = pixels.clone()
    spoiled[2, :3] = torch.nan
    spoiled.requires_grad_()
    found = fit(points, spoiled, camera, mask=mask)
    fewer = fit(points[2:3, 3:], pixels[2:3, 3:], camera)
    np.testing.assert_allclose(found.rotation[2].detach(), fewer.rotation[0], atol=1e-9)
    found.scale.sum().backward()
    assert torch.isfinite(spoiled.grad).all()
    assert not spoiled.grad[2, :3].any()
    by_nan = fit(points, spoiled, camera)  # not finite: ignored
    np.testing.assert_allclose(by_nan.rotation.detach(), found.rotation.detach(), atol=1e-12)


def test_failed_and_degenerate_problems_are_marked_and_do_not_raise() -> None:
    points, pixels, camera = tensors(5)
    points, pixels = points.clone(), pixels.clone()
    points[0] = points[0, 0].clone()  # one point, ten times
    points[1, :, 2] = points[1, :, 0]  # a plane
    pixels[2, 3:] = torch.nan  # too few
    pixels[3] = 100.0  # all at one pixel
    points.requires_grad_()
    pixels.requires_grad_()
    found = fit(points, pixels, camera)
    assert found.valid.tolist()[4]
    assert not found.valid[[0, 2]].any()
    total = found.rotation.sum() + found.translation.sum() + found.scale.sum()
    total.backward()
    for gradient in (points.grad, pixels.grad):
        assert torch.isfinite(gradient).all()
        assert not gradient[[0, 2]].any()
        assert gradient[4].any()


def test_second_derivatives_are_refused() -> None:
    points, pixels, camera = tensors(1)
    given = pixels.clone().requires_grad_()
    total = fit(points, given, camera).translation.sum()
    (slopes,) = torch.autograd.grad(total, given, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        slopes.sum().backward()
    with torch.no_grad():
        assert not fit(points, given, camera).rotation.requires_grad


def test_single_precision_is_kept() -> None:
    points, pixels, camera = tensors(3)
    given = pixels.float().requires_grad_()
    found = fit(points.float(), given, camera)
    assert found.rotation.dtype == torch.float32
    found.rotation[:, 0].sum().backward()
    exact = pixels.clone().requires_grad_()
    fit(points, exact, camera).rotation[:, 0].sum().backward()
    assert given.grad.dtype == torch.float32
    np.testing.assert_allclose(given.grad, exact.grad, rtol=2e-2, atol=1e-4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda p, x, c: fit(p, x[0], c),
            "points_2d: shape (10, 2), expected (B, n, 2)",
        ),
        (
            lambda p, x, c: fit(p[:, :5], x, c),
            "points_3d: shape (3, 5, 3) does not expand to (3, 10, 3)",
        ),
        (
            lambda p, x, c: fit(p, x, [c, c]),
            "camera: 2 cameras for 3 problems; give one camera, or one per problem",
        ),
        (
            lambda p, x, c: fit(p, x.round().long(), c),
            "points_2d: expected floating point numbers, got torch.int64; give points_2d.double()",
        ),
        (
            lambda p, x, c: fit(p, x.numpy(), c),
            "points_2d: expected a tensor, got ndarray; convert it with torch.as_tensor(...)",
        ),
        (
            lambda p, x, c: fit(p.numpy(), x, c),
            "points_3d: expected a tensor, got ndarray; convert it with torch.as_tensor(...)",
        ),
        (
            lambda p, x, c: fit(p, x, c, mask=[True] * POINTS),
            "mask: expected a tensor, got list; convert it with torch.as_tensor(...)",
        ),
        (
            lambda p, x, c: fit(p, x, c, sigma=None),
            "sigma: expected a tensor, got NoneType; give a number or a tensor [px]",
        ),
        (
            lambda p, x, c: fit(p, x, None),
            "camera: expected a cadalign.Camera, got NoneType",
        ),
        (
            lambda p, x, c: fit(p, x, Camera(640, 480, 500, 500, 319.5, 239.5, lens="fisheye")),
            "camera: gradients are not implemented for wide lenses; undistort keypoints and "
            "camera first",
        ),
        (
            lambda p, x, c: fit(p, x, Camera.from_size(640, 480)),
            "camera: the focal length is unknown; give it: camera.replace_focal(...)",
        ),
    ],
)
def test_refusals(call: Any, message: str) -> None:
    with pytest.raises(InputError) as refused:
        call(*tensors(3))
    assert str(refused.value) == message
