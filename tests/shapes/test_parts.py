"""Box margins, inflation by the number of keypoints, and confidence regions."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.errors import InputError
from cadalign.shapes.calibration import box_excesses, learn_margins
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.parts import (
    FEW,
    BoxMargins,
    FewKeypoints,
    inflation_with,
    probability_within,
    radius_of,
)

SEEN = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [0.5, 0.5, 0.5]])
OUTWARD = np.array([[-1.0], [1.0]])


def test_a_near_face_is_a_margin_beyond_the_keypoints() -> None:
    rule = BoxMargins(np.full((2, 3), 0.1), np.full((2, 3), 0.2))
    inside = np.array([[0.2, 0.0, -0.25], [0.9, 2.0, 3.25]])
    assert np.allclose(rule.bounds(inside, SEEN), [[-0.1] * 3, [1.1, 2.1, 3.1]])


def test_a_far_face_is_the_linear_one() -> None:
    rule = BoxMargins(np.full((2, 3), 0.1), np.full((2, 3), 0.2))
    far = np.array([[-0.4, -0.5, -0.6], [1.4, 2.5, 3.6]])
    assert np.allclose(rule.bounds(far, SEEN), far)


def test_margins_and_errors_are_learned() -> None:
    rng = np.random.default_rng(0)
    mean = rng.uniform(-0.5, 0.5, (6, 3))
    points = mean + 0.05 * rng.normal(size=(400, 6, 3))
    faces = np.stack([points.min(axis=1) - 0.02, points.max(axis=1) + 0.03], axis=1)
    rows = np.concatenate([points, faces], axis=1)
    vectors = rows.reshape(len(rows), -1)
    covariance = np.cov(vectors.T) + 1e-6 * np.eye(vectors.shape[1])
    mixture = Gaussians(np.ones(1), vectors.mean(axis=0)[None], covariance[None])
    excesses = box_excesses(rows, mixture)
    learned = learn_margins(rows, excesses)
    assert learned is not None
    assert np.allclose(learned.margins, [[0.02] * 3, [0.03] * 3])
    assert ((excesses > learned.tolerances).mean(axis=0) < 0.06).all()
    # Boxes of objects with all keypoints are nearly exact.
    gaps = [
        OUTWARD * (learned.bounds(row[-2:] + OUTWARD * excess, row[:-2]) - row[-2:])
        for row, excess in zip(rows, excesses, strict=True)
    ]
    assert np.abs(gaps).mean() < np.abs(excesses).mean() / 3


def test_models_without_boxes_have_no_margins() -> None:
    rows = np.full((5, 6, 3), np.nan)
    rows[:, :4] = np.random.default_rng(0).normal(size=(5, 4, 3))
    assert learn_margins(rows, np.zeros((5, 2, 3))) is None


def test_negative_tolerances_are_refused() -> None:
    with pytest.raises(InputError, match="tolerances"):
        BoxMargins(np.zeros((2, 3)), np.full((2, 3), -0.1))


# --- inflation and tails ------------------------------------------------------------------------


def test_the_whole_inflation_applies_from_the_typical_number() -> None:
    few = FewKeypoints(typical=12.0, share=0.7)
    assert inflation_with(12, 1.5, few) == inflation_with(100, 1.5, few) == 1.5
    assert inflation_with(3, 1.5, few) == inflation_with(FEW, 1.5, few) == pytest.approx(1.05)
    assert 1.05 < inflation_with(8, 1.5, few) < inflation_with(10, 1.5, few) < 1.5


def test_inflation_is_constant_without_a_decrease() -> None:
    assert inflation_with(3, 1.5, None) == 1.5


@pytest.mark.parametrize(
    ("typical", "share", "name"),
    [(12.0, 0.0, "share"), (12.0, float("nan"), "share"), (6.0, 0.9, "typical")],
)
def test_a_number_out_of_range_is_refused(typical: float, share: float, name: str) -> None:
    with pytest.raises(InputError, match=name):
        FewKeypoints(typical=typical, share=share)


@pytest.mark.parametrize("freedom", [None, 3.0, 5.0, 20.0])
@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_the_radius_inverts_the_probability(dimension: int, freedom: float | None) -> None:
    for probability in (0.05, 0.68, 0.95, 0.999):
        square = radius_of(probability, dimension, freedom) ** 2
        assert probability_within(square, dimension, freedom) == pytest.approx(probability)


@pytest.mark.parametrize("freedom", [5.0, 8.0])
def test_regions_hold_errors_of_their_covariance(freedom: float) -> None:
    rng = np.random.default_rng(0)
    scale = np.sqrt((freedom - 2) / rng.chisquare(freedom, 100_000))
    errors = scale[:, None] * rng.normal(size=(100_000, 3))
    assert np.allclose(np.cov(errors.T), np.eye(3), atol=0.15)
    squares = (errors**2).sum(axis=1)
    for probability in (0.5, 0.68, 0.95, 0.99):
        inside = (squares < radius_of(probability, 3, freedom) ** 2).mean()
        assert inside == pytest.approx(probability, abs=0.005)


def test_many_degrees_of_freedom_are_gaussian() -> None:
    assert radius_of(0.95, 3, 1e6) == pytest.approx(radius_of(0.95, 3), rel=1e-4)
