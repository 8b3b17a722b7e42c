"""Marks of keypoints: regions of uncertainty, and the arguments that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.refusals import refusal_text

from cadalign import Camera
from cadalign.render import draw_overlay
from cadalign.render.drawing.layers import REGION_SHARE, UNSEEN_COLOR, confidence_regions

CAMERA = Camera(64, 48, 60.0, 70.0, 31.5, 23.5)
BENT = Camera(64, 48, 60.0, 70.0, 31.5, 23.5, (-0.2, 0.05, 0.01, 0.002))


def random_covariance(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return np.asarray(root @ root.T)


@given(st.integers(0, 10_000))
def test_regions_hold_their_share(seed: int) -> None:
    rng = np.random.default_rng(seed)
    center, covariance = rng.normal(0, 100, 2), 100 * random_covariance(rng, 2) + 9 * np.eye(2)
    (region,) = confidence_regions(center[None], covariance[None])
    offsets = region - center
    squares = np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(covariance), offsets)
    np.testing.assert_allclose(1 - np.exp(-squares / 2), REGION_SHARE)  # chi-square, 2 degrees


def test_small_regions_are_left_out() -> None:
    covariances = np.array([0.1 * np.eye(2), np.zeros((2, 2)), np.eye(2)])
    assert len(confidence_regions(np.zeros((3, 2)), covariances)) == 1


@pytest.mark.parametrize("camera", [CAMERA, BENT])
@given(seed=st.integers(0, 10_000))
def test_projected_covariances_are_propagated(camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    point, covariance = rng.uniform([-1, -1, 4], [1, 1, 8]), random_covariance(rng, 3)
    steps = 1e-6 * np.eye(3)
    slopes = (camera.project(point + steps) - camera.project(point - steps)).T / 2e-6
    (found,) = camera.projected_covariances(point[None], covariance[None])
    np.testing.assert_allclose(found, slopes @ covariance @ slopes.T, rtol=1e-4, atol=1e-4)


def test_unobserved_keypoints_and_regions_are_drawn() -> None:
    black = np.zeros((480, 640, 3), np.uint8)
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    regions = confidence_regions(np.array([[400.0, 200.0]]), 400 * np.eye(2)[None])
    drawn = draw_overlay(black, camera, unseen=[[100.0, 300.0]], regions=regions, legend=False)
    near = (np.abs(drawn.astype(int) - UNSEEN_COLOR).max(axis=2) < 60).nonzero()
    assert np.hypot(near[1] - 100, near[0] - 300).max() < 6
    on_curve = drawn[200, 400 + 48 : 400 + 51].max()
    assert on_curve > 80
    assert not drawn[200, 380:420].any()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"unseen": [[1.0, 2.0, 3.0]]}, "unseen: shape (1, 3), expected (n, 2)"),
        ({"regions": [[1.0, 2.0]]}, "regions: shape (1, 2), expected (n, n, 2)"),
    ],
)
def test_wrong_shapes_are_refused(arguments: dict[str, object], text: str) -> None:
    black = np.zeros((48, 64, 3), np.uint8)
    assert refusal_text(lambda: draw_overlay(black, CAMERA, **arguments)) == text  # type: ignore[arg-type]
