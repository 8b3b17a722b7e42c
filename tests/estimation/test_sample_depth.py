"""Depths of keypoints in a depth image: the window about them."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.estimation.pack import sample_depth


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("away", "is_seen"), [(-3, 0), (-2, 1), (0, 1), (2, 1), (3, 0)])
def test_windows_reach_two_pixels_to_every_side(axis: int, away: int, is_seen: int) -> None:
    image = np.full((15, 15), np.nan)
    image[7 + away] = 2.0
    found = sample_depth(image if axis else image.T, np.array([[7.0, 7.0]]), sigma=0.01)
    assert np.isfinite(found[0]) == bool(is_seen)
