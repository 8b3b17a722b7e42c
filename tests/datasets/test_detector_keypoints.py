"""A real street photo: 36 keypoints from a network, a generic car, and a car of another shape."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cadalign import Box, Camera, RansacOptions, fit
from cadalign.io.images import read_photo

THRESHOLD_PX = 8.0
# Of another shape, the car has several sets of inliers that are about as good: few samples find one
# or the other of them.
SAMPLES = 2000
# The generic car is a saloon, the photo's an estate: its tail is another.
TAIL = [11, 12, 13, 29, 30, 31]


@pytest.fixture(scope="module")
def car(real_data: Path) -> Path:
    return real_data / "photos" / "kitti_car_01"


def keypoints_in(car: Path) -> tuple[np.ndarray, np.ndarray, Camera]:
    """The generic car's points, the network's pixels, and the camera."""
    matrix = np.loadtxt(car / "intrinsics.txt")
    box = np.loadtxt(car / "bbox.txt")
    in_crop = np.loadtxt(car / "keypoints.txt").reshape(-1, 3)[:, :2]
    height, width = read_photo(car / "image.png").shape[:2]
    camera = Camera(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    return np.loadtxt(car / "meanShape.txt"), box[:2] - 1 + in_crop * box[2:] / 64, camera


def overlap(points_2d: np.ndarray, box: np.ndarray) -> float:
    """Intersection over union of the points' bounding box and a box (x, y, width, height)."""
    low, high = points_2d.min(axis=0), points_2d.max(axis=0)
    shared = np.prod(np.minimum(high, box[:2] + box[2:]) - np.maximum(low, box[:2]))
    return float(shared / (np.prod(high - low) + np.prod(box[2:]) - shared))


def test_box_and_points_lie_on_the_car(car: Path) -> None:
    points_3d, points_2d, camera = keypoints_in(car)
    ransac = RansacOptions(max_reproj_error=THRESHOLD_PX, min_iterations=SAMPLES)
    result = fit(points_3d, points_2d, camera, sigma=None, ransac=ransac)
    assert result.inliers.sum() >= 28
    assert not result.inliers[TAIL].any()
    assert np.median(np.linalg.norm(result.residuals, axis=1)) < 4.5
    assert result.std is not None
    assert result.std.rotation_deg < 2.0
    assert max(result.std.scale) < 0.1
    assert result.alignment.scale.min() > 0.7
    assert result.alignment.scale.max() < 1.2
    box = np.loadtxt(car / "bbox.txt")
    kept = result.inliers
    reprojected = camera.project(result.alignment.apply(points_3d))
    seen = np.concatenate([points_2d[kept].min(axis=0), np.ptp(points_2d[kept], axis=0)])
    assert overlap(reprojected[kept], seen) > 0.9
    bounds = np.array([points_3d.min(axis=0), points_3d.max(axis=0)])
    corners = Box.from_model(bounds, result.alignment).corners
    assert overlap(camera.project(corners), box) > 0.75
    # The model's y is up, and it stands on the road: the camera's y points down.
    assert result.alignment.rotation[1, 1] < -0.99
