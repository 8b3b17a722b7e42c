"""Losses: zero at the truth, the least over symmetries, with useful gradients."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.problems import problem_of

from cadalign import Camera, Symmetry
from cadalign.errors import InputError

torch = pytest.importorskip("torch", reason='needs pip install -e ".[torch]"')
from cadalign.torch import (  # noqa: E402
    PoseBatch,
    box_loss,
    fit,
    posterior_loss,
    reprojection_loss,
    rotation_loss,
)

pytestmark = pytest.mark.slow
CAMERA = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
CORNERS = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * 3)
BOUNDS = torch.tensor([[-1.0, -1, -1], [1, 1, 1]]).double()


def poses(turns: np.ndarray, scale: Any = (1.0, 1.0, 1.0)) -> PoseBatch:
    """Poses (B,) of rotation vectors (B, 3), 8 away."""
    count = len(turns)
    return PoseBatch(
        torch.tensor(Rotation.from_rotvec(turns).as_matrix()),
        torch.tensor([[0.1, 0.2, 8.0]] * count).double(),
        torch.tensor([list(scale)] * count).double(),
    )


def losses(found: PoseBatch, truth: PoseBatch, symmetry: Symmetry | None) -> list[Any]:
    return [
        rotation_loss(found, truth, symmetry=symmetry),
        reprojection_loss(found, truth, CORNERS, CAMERA, symmetry=symmetry),
        box_loss(found, truth, BOUNDS, symmetry=symmetry),
    ]


@pytest.mark.parametrize(
    ("symmetry", "turn"),
    [
        (None, 0.0),
        (Symmetry.around((0, 1, 0), fold=2), math.pi),
        (Symmetry.around((0, 1, 0), fold=4), math.pi / 2),
        (Symmetry.around((0, 1, 0), fold=None), math.radians(10)),
    ],
)
def test_zero_for_what_looks_the_same_and_positive_otherwise(
    symmetry: Symmetry | None, turn: float
) -> None:
    rng = np.random.default_rng(0)
    truth = poses(rng.normal(0, 1, (5, 3)))
    about = torch.tensor(Rotation.from_rotvec([0, turn, 0]).as_matrix())
    same = PoseBatch(truth.rotation @ about, truth.translation, truth.scale)
    for loss in losses(same, truth, symmetry):
        assert loss.max() < 1e-5
    tilt = torch.tensor(Rotation.from_rotvec([0.2, 0, 0]).as_matrix())
    other = PoseBatch(truth.rotation @ tilt, truth.translation, truth.scale)
    for loss in losses(other, truth, symmetry):
        assert loss.min() > 1e-3


def test_one_truth_is_that_of_all_and_other_numbers_are_refused() -> None:
    found, truth = poses(np.full((4, 3), 0.3)), poses(np.zeros((3, 3)))
    one = PoseBatch(truth.rotation[:1], truth.translation[:1], truth.scale[:1])
    for loss in losses(found, one, None):
        assert loss.shape == (4,)
    pixels = found.project(CORNERS, CAMERA)
    seen = fit(CORNERS, pixels, CAMERA)
    for call in (
        lambda: rotation_loss(found, truth),
        lambda: reprojection_loss(found, truth, CORNERS, CAMERA),
        lambda: box_loss(found, truth, BOUNDS),
        lambda: posterior_loss(seen, truth, CORNERS, pixels, CAMERA),
    ):
        with pytest.raises(InputError, match="truth: 3 alignments, but 4 are compared with it"):
            call()


def test_rotation_loss_is_one_minus_the_cosine() -> None:
    angles = torch.tensor([0.0, 0.3, 1.2, math.pi]).double()
    found = poses(np.outer(angles, [0, 0, 1.0]))
    loss = rotation_loss(found, poses(np.zeros((4, 3))))
    np.testing.assert_allclose(loss, 1 - torch.cos(angles), atol=1e-12)


@pytest.mark.parametrize("unit", [0.01, 1.0, 50.0])
def test_the_loss_of_boxes_is_in_diagonals_whatever_the_unit(unit: float) -> None:
    truth = poses(np.zeros((2, 3)))
    bounds = unit * torch.tensor([[0.0, 0.0, 0.0], [2.0, 2.0, 1.0]]).double()
    diagonal = float(((bounds[1] - bounds[0]) * truth.scale[0]).norm())
    shift = torch.tensor([[0.25 * diagonal, 0.0, 0.0], [0.0, 0.0, diagonal]])
    moved = PoseBatch(truth.rotation, truth.translation + shift.double(), truth.scale)
    np.testing.assert_allclose(box_loss(moved, truth, bounds), [0.25, 1.0], rtol=1e-5)


def test_descent_on_losses_through_the_fit_brings_keypoints_to_the_truth() -> None:
    problem = problem_of(3, points=10, noise_px=3.0)
    alignment = problem.alignment
    truth = PoseBatch(
        *(
            torch.tensor(each)[None]
            for each in (alignment.rotation, alignment.translation, alignment.scale)
        )
    )
    points = torch.tensor(problem.points_3d)
    pixels = torch.tensor(problem.points_2d)[None].requires_grad_()
    optimizer = torch.optim.Adam([pixels], lr=0.2)
    values = []
    for _ in range(60):
        found = fit(points, pixels, problem.camera)
        loss = (
            10 * rotation_loss(found, truth)
            + reprojection_loss(found, truth, points, problem.camera)
            + box_loss(found, truth, BOUNDS)
        ).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        values.append(loss.item())
    assert values[-1] < 0.2 * values[0]


def seen_problem(noise: float) -> tuple[Any, Any, PoseBatch]:
    truth = poses(np.array([[0.3, 0.5, 0.1]]), (1.0, 1.2, 0.9))
    generator = torch.Generator().manual_seed(0)
    exact = truth.project(CORNERS, CAMERA)
    return CORNERS, exact + noise * torch.randn(exact.shape, generator=generator).double(), truth


def test_posterior_integral_is_laplaces_where_keypoints_are_precise() -> None:
    points, pixels, _ = seen_problem(0.1)
    found = fit(points, pixels, CAMERA, sigma=0.1)
    at_fit = PoseBatch(found.rotation, found.translation, found.scale)
    loss = posterior_loss(found, at_fit, points, pixels, CAMERA, sigma=0.1, samples=4000)
    kept = [0, 1, 2, 3, 4, 5, 7, 8]
    covariance = found.covariance[0][kept][:, kept]
    laplace = 0.5 * torch.logdet(2 * math.pi * covariance)
    assert abs(loss.item() - laplace.item()) < 0.1
    again = posterior_loss(found, at_fit, points, pixels, CAMERA, sigma=0.1, samples=4000)
    assert loss.item() == again.item()


def test_posterior_loss_prefers_the_truth_and_the_right_noise() -> None:
    points, pixels, truth = seen_problem(1.0)
    values = {}
    for sigma in (0.3, 1.0, 4.0):
        found = fit(points, pixels, CAMERA, sigma=sigma)
        values[sigma] = posterior_loss(found, truth, points, pixels, CAMERA, sigma=sigma).item()
    assert min(values, key=values.__getitem__) == 1.0
    found = fit(points, pixels, CAMERA)
    wrong = PoseBatch(truth.rotation, truth.translation * 1.2, truth.scale)
    assert posterior_loss(found, wrong, points, pixels, CAMERA) > values[1.0]


def test_posterior_loss_has_gradients_by_keypoints_and_sigmas() -> None:
    points, pixels, truth = seen_problem(1.0)
    given = pixels.clone().requires_grad_()
    sigma = torch.ones(1, 8, dtype=torch.float64, requires_grad=True)
    found = fit(points, given.detach(), CAMERA, sigma=sigma.detach())

    def value(pixels: Any, sigma: Any) -> Any:
        return posterior_loss(found, truth, points, pixels, CAMERA, sigma=sigma, samples=4000)

    value(given, sigma).sum().backward()
    assert torch.isfinite(given.grad).all()
    direction = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    step = 0.05
    ends = [value(pixels + s * step * direction, sigma.detach()) for s in (1, -1)]
    slope = ((ends[0] - ends[1]) / (2 * step)).item()
    assert slope == pytest.approx((given.grad * direction).sum().item(), rel=0.1)


def test_invalid_estimates_cost_nothing() -> None:
    points, pixels, truth = seen_problem(1.0)
    pixels = torch.full_like(pixels, torch.nan).requires_grad_()
    found = fit(points, pixels, CAMERA)
    total = sum(each.sum() for each in losses(found, truth, None))
    total = total + posterior_loss(found, truth, points, pixels, CAMERA).sum()
    assert total.item() == 0
    total.backward()


def test_posterior_loss_leaves_out_the_keypoints_that_the_fit_does() -> None:
    points, pixels, truth = seen_problem(1.0)
    given = pixels.expand(3, -1, -1).clone()
    sigma, mask = torch.ones(3, 8).double(), torch.ones(3, 8, dtype=torch.bool)
    given[0, 2], sigma[1, 2], mask[2, 2] = torch.nan, 0.0, False
    points = points.clone().requires_grad_()
    given.requires_grad_()
    sigma.requires_grad_()
    true = PoseBatch(
        *(each.expand(3, *each.shape[1:]) for each in vars(truth).values() if each is not None)
    )
    found = fit(points, given, CAMERA, sigma=sigma, mask=mask)
    values = posterior_loss(
        found, true, points, given, CAMERA, sigma=sigma, mask=mask, samples=4000
    )
    assert found.valid is not None
    assert found.valid.all()
    torch.testing.assert_close(values, values[2].expand(3), atol=0.05, rtol=0)
    values.sum().backward()
    for each in (given, sigma, points):
        assert torch.isfinite(each.grad).all()
        assert each.grad.any()


def test_posterior_loss_of_keypoints_that_tell_nothing_is_of_the_truths_size() -> None:
    points, _, truth = seen_problem(1.0)
    generator = torch.Generator().manual_seed(0)
    middle = 300 + 0.5 * torch.randn(6, 8, 2, generator=generator).double()  # as of no training
    middle.requires_grad_()
    found = fit(points, middle, CAMERA, sigma=10.0)
    true = PoseBatch(
        truth.rotation.expand(6, 3, 3), truth.translation.expand(6, 3), truth.scale.expand(6, 3)
    )
    few, many = (
        posterior_loss(
            *(found, true, points, middle, CAMERA), sigma=10.0, loss="huber", samples=samples
        )
        for samples in (128, 8000)
    )
    assert found.valid is not None
    assert found.valid.all()
    assert (few > 0).all()
    assert ((few > many / 2) & (few < 2 * many)).all()
    few.sum().backward()
    assert torch.isfinite(middle.grad).all()
    assert middle.grad.any(dim=2).all()


def test_posterior_loss_of_an_empty_batch_is_empty() -> None:
    points, pixels, _ = seen_problem(1.0)
    none = pixels[:0].clone().requires_grad_()
    found = fit(points, none, CAMERA, focal="known")
    value = posterior_loss(found, found, points, none, CAMERA)
    assert value.shape == (0,)
    value.sum().backward()


def test_posterior_loss_knows_the_prior_on_the_stretch() -> None:
    points, pixels, _ = seen_problem(1.0)
    found = fit(points, pixels, CAMERA, stretch_sigma=0.01)
    at_fit = PoseBatch(found.rotation, found.translation, found.scale)
    with_prior, without = (
        posterior_loss(found, at_fit, points, pixels, CAMERA, stretch_sigma=sigma, samples=4000)
        for sigma in (0.01, None)
    )
    kept = [0, 1, 2, 3, 4, 5, 7, 8]
    assert found.covariance is not None
    laplace = 0.5 * torch.logdet(2 * math.pi * found.covariance[0][kept][:, kept])
    assert abs(with_prior.item() - laplace.item()) < 0.2
    assert without > with_prior + 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loss": "foo"}, "loss: unknown loss 'foo'"),
        ({"loss_scale": -1.0}, "loss_scale: -1.0 is not positive"),
        ({"samples": 0}, "samples: 0 is not a whole number from 1"),
        ({"rounds": 0}, "rounds: 0 is not a whole number from 1"),
        ({}, "found: the poses have estimated focal lengths"),
    ],
)
def test_posterior_loss_refuses_what_it_cannot_integrate(
    options: dict[str, Any], message: str
) -> None:
    points, pixels, truth = seen_problem(1.0)
    found = fit(points, pixels, CAMERA, focal="known" if options else "estimate")
    with pytest.raises(InputError, match=re.escape(message)):
        posterior_loss(found, truth, points, pixels, CAMERA, **options)


def test_fits_in_single_precision_are_compared_with_truths_in_double() -> None:
    camera = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5]).double()] * 3)
    bounds = torch.stack([corners.amin(dim=0), corners.amax(dim=0)])
    truth = PoseBatch(
        torch.eye(3).double()[None],
        torch.tensor([[0.1, 0.0, 5.0]]).double(),
        torch.tensor([[1.0, 1.2, 0.8]]).double(),
    )
    noise = torch.randn(1, 8, 2, generator=torch.Generator().manual_seed(0))
    pixels = (truth.project(corners, camera).float() + noise).requires_grad_()
    found = fit(corners, pixels, camera)
    total = (
        rotation_loss(found, truth)
        + reprojection_loss(found, truth, corners, camera)
        + box_loss(found, truth, bounds)
        + posterior_loss(found, truth, corners, pixels, camera)
    )
    total.sum().backward()
    assert pixels.grad.dtype == torch.float32
    assert torch.isfinite(pixels.grad).all()
    assert pixels.grad.any()
    with pytest.raises(InputError, match=r"bounds: shape \(8, 3\), expected \(2, 3\)"):
        box_loss(found, truth, corners)
    with pytest.raises(InputError, match="symmetry: expected"):
        rotation_loss(found, truth, symmetry="y")  # type: ignore[arg-type]
