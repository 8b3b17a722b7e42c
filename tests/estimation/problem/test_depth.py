"""Depths of keypoints in a depth image: windows and occlusion."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import CAMERA, depth_image, keypoints, seen, truth_of

from cadalign import Model, align
from cadalign.estimation.pack import sample_depth


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("away", "is_seen"), [(-3, 0), (-2, 1), (0, 1), (2, 1), (3, 0)])
def test_windows_reach_two_pixels_to_every_side(axis: int, away: int, is_seen: int) -> None:
    image = np.full((15, 15), np.nan)
    image[7 + away] = 2.0
    found, _ = sample_depth(image if axis else image.T, np.array([[7.0, 7.0]]), sigma=0.01)
    assert np.isfinite(found[0]) == bool(is_seen)


def test_two_hidden_keypoints_of_ten_hardly_shrink_the_object() -> None:
    points, truth, sigma = keypoints(10), truth_of(), 0.005
    places = CAMERA.project(truth.apply(points)).round().astype(int)
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        image = depth_image(points, truth)
        for x, y in places[rng.permutation(10)[:2]]:  # each by something else of the object
            image[y - 4 : y + 5, x - 4 : x + 5] *= 1 - rng.uniform(0.03, 0.2)
        image *= 1 + sigma * rng.normal(size=image.shape)
        view = seen(points, truth, np.eye(4), rng, depth=image, depth_sigma=sigma)
        result = align(Model(points_3d=points), view)
        assert result.std is not None
        lost = truth.translation[2] - result.alignment.translation[2]
        errors.append(lost / result.std.translation[2])
    assert np.mean(np.abs(errors) < 1.96) > 0.85
    assert np.abs(np.mean(errors)) < 0.6
