"""Boxes from keypoints, margins beyond them, and linear boxes."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.errors import InputError
from cadalign.shapes.calibration import excesses_of, learn_margins, margins_of
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.parts import BoxMargins

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
    excesses = excesses_of(rows, mixture)
    learned = learn_margins(rows, excesses)
    assert learned is not None
    assert np.allclose(learned.margins, [[0.02] * 3, [0.03] * 3])
    assert ((excesses > learned.tolerances).mean(axis=0) < 0.06).all()
    # Objects of which all keypoints are given have nearly their true boxes.
    gaps = [
        OUTWARD * (learned.bounds(row[-2:] + OUTWARD * excess, row[:-2]) - row[-2:])
        for row, excess in zip(rows, excesses, strict=True)
    ]
    assert np.abs(gaps).mean() < np.abs(excesses).mean() / 3


def test_models_without_boxes_have_no_margins() -> None:
    rows = np.full((5, 6, 3), np.nan)
    rows[:, :4] = np.random.default_rng(0).normal(size=(5, 4, 3))
    assert learn_margins(rows, np.zeros((5, 2, 3))) is None
    assert np.isnan(margins_of(rows)).all()


def test_negative_tolerances_are_refused() -> None:
    with pytest.raises(InputError, match="tolerances"):
        BoxMargins(np.zeros((2, 3)), np.full((2, 3), -0.1))
