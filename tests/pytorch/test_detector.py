"""The small detector: training lowers its loss, and held-out errors fall by a factor."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

from cadalign.datasets import sample_models
from cadalign.errors import InputError

torch = pytest.importorskip("torch", reason='needs pip install -e ".[torch]"')
from cadalign.torch import PoseBatch, fit, rotation_loss  # noqa: E402
from cadalign.torch.detector import (  # noqa: E402  # noqa: E402
    KeypointDetector,
    RenderedViews,
    learned_shape,
    render_views,
    train,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def views() -> tuple[RenderedViews, RenderedViews]:
    """Views to train with, and those of another model."""
    torch.set_num_threads(1)  # others run beside
    cars = list(sample_models(per_category=5, categories=["car"]))
    ids = tuple(each.semantic_id for each in cars[0].keypoints)[::2]
    return (
        render_views(cars[:4], ids=ids, count=160, size=48),
        render_views(cars[4:], ids=ids, count=16, size=48, seed=1),
    )


def test_views_are_the_same_for_the_same_seed_and_show_their_keypoints(
    views: tuple[RenderedViews, RenderedViews],
) -> None:
    known, _ = views
    cars = list(sample_models(per_category=4, categories=["car"]))
    again = render_views(cars, ids=known.ids, count=3, size=48)
    assert (again.images == known.images[:3]).all()
    assert known.visible.any(axis=1).all()
    assert known.camera.contains(known.points_2d.reshape(-1, 2)).all()


def test_training_lowers_loss_and_held_out_errors_by_a_factor(
    views: tuple[RenderedViews, RenderedViews],
) -> None:
    known, held_out = views
    detector = KeypointDetector.untrained(len(known.ids), width=16)

    def error() -> float:
        pixels, _ = detector.predict(held_out)
        return float(np.median(np.linalg.norm(pixels - held_out.points_2d, axis=2)))

    before = error()
    losses = train(detector, known, steps=120, batch=16, rate=3e-3)
    assert np.mean(losses[-10:]) < 0.7 * np.mean(losses[:10])
    assert error() < before / 1.4
    calibrated = detector.calibrated(held_out)
    pixels, sigma = calibrated.predict(held_out)
    inside = np.linalg.norm(pixels - held_out.points_2d, axis=2) < 1.1774 * sigma  # the median
    assert inside.mean() == pytest.approx(0.5, abs=0.02)


def test_the_pose_layer_lowers_its_loss_in_training(
    views: tuple[RenderedViews, RenderedViews],
) -> None:
    known, _ = views
    detector = KeypointDetector.untrained(len(known.ids), width=16)
    train(detector, known, steps=40, batch=12, rate=3e-3)
    points = torch.as_tensor(known.points_3d)
    values: list[float] = []

    def through_the_fit(pixels: torch.Tensor, sigma: torch.Tensor, rows: torch.Tensor) -> object:
        found = fit(points[rows], pixels.double(), known.camera, sigma=sigma.double())
        truth = PoseBatch(
            torch.as_tensor(known.rotation)[rows],
            torch.as_tensor(known.translation)[rows],
            torch.ones(len(rows), 3).double(),
        )
        loss = rotation_loss(found, truth).float()
        values.append(float(loss.detach().mean()))
        return loss

    train(detector, known, steps=130, batch=12, rate=1e-3, pose_loss=through_the_fit)
    assert np.mean(values[-10:]) < 0.5 * np.mean(values[:10])


def test_a_shape_is_learned_of_the_models_keypoints() -> None:
    cars = list(sample_models(per_category=8, categories=["car"]))
    ids = tuple(each.semantic_id for each in cars[0].keypoints)
    shape = learned_shape(cars, ids, "car")
    assert shape.ids == ids


def test_an_untrained_network_leaves_the_programs_random_numbers_alone() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = KeypointDetector.untrained(4, seed=1)
    assert (torch.rand(3) == expected).all()
    image = torch.full((1, 48, 48, 3), 90.0)
    again = KeypointDetector.untrained(4, seed=1)
    assert (first(image)[0] == again(image)[0]).all()


@pytest.mark.parametrize(("height", "width"), [(33, 50), (60, 100)])
def test_images_of_any_size_are_read(height: int, width: int) -> None:
    detector = KeypointDetector.untrained(4, width=8)
    image = torch.full((2, height, width, 3), 90.0)
    assert detector.logits(image).shape == (2, 4, -(-height // 4), -(-width // 4))
    assert detector(image)[0].shape == (2, 4, 2)


def test_a_detector_is_pickled() -> None:
    detector = KeypointDetector.untrained(4, width=8)
    image = torch.full((1, 48, 48, 3), 90.0)
    assert (pickle.loads(pickle.dumps(detector))(image)[0] == detector(image)[0]).all()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda views: KeypointDetector.untrained(0), "keypoints: 0 is not a whole number >= 1"),
        (lambda views: KeypointDetector.untrained(3, width=12), "width: 12 is not a multiple of 8"),
        (
            lambda views: train(KeypointDetector.untrained(3), views, steps=1, batch=0),
            "batch: 0 is not a whole number >= 1",
        ),
        (lambda views: render_views([], ids=(0,), count=1), "models: there is none"),
        (lambda views: render_views([], ids=(0,), count=0), "count: 0 is not a whole number >= 1"),
    ],
)
def test_wrong_numbers_are_refused(
    views: tuple[RenderedViews, RenderedViews],
    call: Callable[[RenderedViews], object],
    words: str,
) -> None:
    with pytest.raises(InputError, match=words):
        call(views[0])
