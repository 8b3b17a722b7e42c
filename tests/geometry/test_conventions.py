"""Conversions of pixel conventions and axes agree with renderings."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from cadalign import Alignment, Camera, Mesh
from cadalign.geometry.pixels import rescaled_pixels
from cadalign.render import RaycastRenderer, Scene

CAMERA = Camera(160, 120, 170.0, 140.0, 60.25, 71.75, (-0.25, 0.06, 0.004, -0.003))
SOURCES = Path(__file__).parents[2]


def centroid(camera: Camera, center: np.ndarray) -> np.ndarray:
    """Opacity-weighted mean pixel of a rendered small square."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.036
    mesh = Mesh(center + corners, [[0, 1, 2], [0, 2, 3]])
    frame = RaycastRenderer().render(Scene(mesh), camera, Alignment.identity(), samples=256)
    return image_centroid(frame.color[:, :, 3].astype(float))


def image_centroid(weight: np.ndarray) -> np.ndarray:
    rows, columns = np.indices(weight.shape)
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("factor", [2, 3, 0.5])
def test_a_resized_camera_renders_at_the_rescaled_pixels(factor: float) -> None:
    pixel = np.array([80.0, 60.0])
    center = 3.0 * np.append(CAMERA.normalize([pixel])[0], 1.0)
    resized = CAMERA.resize(round(160 * factor), round(120 * factor))
    expected = rescaled_pixels(pixel, factor)
    np.testing.assert_allclose(resized.project(center[None])[0], expected, atol=1e-9)
    if factor > 1:  # a marker of few pixels covers them unevenly
        np.testing.assert_allclose(centroid(resized, center), expected, atol=0.02)


@pytest.mark.parametrize("offset", [(10, 20), (-5, 3)])
def test_a_cropped_camera_renders_the_part_of_the_image(offset: tuple[int, int]) -> None:
    center = 3.0 * np.append(CAMERA.normalize([[60.0, 50.0]])[0], 1.0)
    part = CAMERA.crop(*offset, 100, 80)
    expected = CAMERA.project(center[None])[0] - offset
    np.testing.assert_allclose(part.project(center[None])[0], expected, atol=1e-9)
    assert (part.width, part.height, part.distortion) == (100, 80, CAMERA.distortion)


def test_rescaled_pixels_agree_with_opencv_resizing() -> None:
    image = np.zeros((120, 160), dtype=np.float32)
    image[40:44, 90:96] = 1
    small = cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA)
    moved = rescaled_pixels(image_centroid(image), 0.5)
    np.testing.assert_allclose(image_centroid(small), moved, atol=1e-6)


def test_no_other_module_repeats_the_conversions() -> None:
    patterns = re.compile(r"[\[(]1(\.0)?, -1(\.0)?, -1(\.0)?[\])]|c[xy] [+-] 0?\.5|PIXEL_CENTRE = ")
    found = [
        path.relative_to(SOURCES).as_posix()
        for folder in ("cadalign", "datasets", "render")
        for path in (SOURCES / folder).rglob("*.py")
        if patterns.search(path.read_text(encoding="utf-8"))
    ]
    assert {Path(name).name for name in found} == {"alignment.py", "pixels.py"}, found
