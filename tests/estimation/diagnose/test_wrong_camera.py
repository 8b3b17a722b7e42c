"""Cameras that the keypoints contradict are named: another image size, another focal length."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cadalign import Alignment, Camera, Model, View, align, fit
from cadalign.estimation import diagnose
from cadalign.estimation.fit import fit_once
from cadalign.estimation.result import Result
from cadalign.geometry.rotations import rotation_from_vector

CAMERA = Camera(640, 480, 935, 935, 319.5, 239.5)
COUNT = 30


def fitted(seed: int, *, factor: float = 1.0, focal: float = 1.0, points: int = 20) -> Result:
    """Fit keypoints from an image of ``factor`` times the camera's size."""
    rng = np.random.default_rng(seed)
    model = rng.uniform(-0.3, 0.3, (points, 3))
    place = [rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), rng.uniform(1.5, 2.5)]
    rotation = rotation_from_vector(rng.normal(0, 1.5, 3))
    truth = Alignment(rotation, place, [1, *rng.uniform(0.5, 2, 2)])
    pixels = CAMERA.project(truth.apply(model)) + rng.normal(0, 1, (points, 2))
    pixels = (pixels + 0.5) * factor - 0.5
    told = Camera(640, 480, focal * 935, focal * 935, 319.5, 239.5)
    return fit(model, pixels, told, sigma=factor)


def said(factor: float, focal: float) -> list[str]:
    found = [fitted(seed, factor=factor, focal=focal).warnings for seed in range(COUNT)]
    return [" ".join(map(str, each)) for each in found]


@pytest.mark.parametrize(
    ("factor", "size"), [(0.5, "320 x 240"), (2.0, "1280 x 960")], ids=["half", "double"]
)
def test_images_of_another_size_are_named(factor: float, size: str) -> None:
    texts = said(factor, 1.0)
    assert sum(bool(text) for text in texts) >= 0.95 * COUNT
    assert sum(f"images of {size} px" in text for text in texts) >= 0.6 * COUNT


def test_another_focal_length_is_named() -> None:
    texts = said(1.0, 1.3)
    assert sum("contradict the camera" in text for text in texts) >= 0.6 * COUNT


def test_right_cameras_are_not_blamed() -> None:
    texts = [text for count in (6, 8, 20) for text in _right(count)]
    assert sum("contradict the camera" in text for text in texts) <= 0.01 * len(texts)


def _right(count: int) -> list[str]:
    return [" ".join(map(str, fitted(seed, points=count).warnings)) for seed in range(100)]


def test_few_right_keypoints_are_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their residuals are too small for another camera to improve them."""
    results = [fitted(seed, points=7) for seed in range(30)]
    fits = []

    def counted(*given: Any) -> Any:
        fits.append(given)
        return fit_once(*given)

    monkeypatch.setattr(diagnose, "fit_once", counted)
    assert not any(result.warnings for result in results)
    assert len(fits) <= 3


def test_named_camera_is_kept_in_json() -> None:
    found = map(_of_double_size, range(20))
    result = next(each for each in found if each.warnings[0].kind == "mistake")
    assert Result.from_dict(result.to_dict()).warnings == result.warnings


def _of_double_size(seed: int) -> Result:
    return fitted(seed, factor=2.0)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (Camera(640, 480, 1870, 1870, 639.5, 479.5), "the middle of an image of 1280 x 960 px"),
        (Camera(640, 480, 467.5, 467.5, 159.5, 119.5), "the middle of an image of 320 x 240 px"),
        (Camera(640, 480, 935, 935, 900, 239.5), "(900, 239.5) is far from the middle"),
        (Camera(640, 480, 935, 935, 0, 0), "(0, 0) is far from the middle"),
    ],
    ids=["larger image", "smaller image", "outside", "corner"],
)
def test_principal_points_of_other_images_are_named(camera: Camera, words: str) -> None:
    points, pixels = _seen_by(CAMERA)
    assert words in " ".join(map(str, fit(points, pixels, camera).warnings))
    similar = Model(points_3d=points, shape_sigma=0.03)
    views = [View(CAMERA, pixels), View(camera, pixels)]
    (named,) = (each for each in align(similar, views).warnings if words in each.text)
    assert named.text.startswith("views[1]: ")
    assert (named.kind, named.view) == ("camera", 1)


@pytest.mark.parametrize("corner", [(100, 50), (150, 100), (40, 0)])
def test_principal_points_of_parts_of_photos_are_not(corner: tuple[int, int]) -> None:
    camera = CAMERA.crop(*corner, 480, 360)
    points, pixels = _seen_by(camera)
    assert "principal" not in " ".join(map(str, fit(points, pixels, camera).warnings))


def _seen_by(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (20, 3))
    pose = Alignment(rotation_from_vector(rng.normal(0, 1.5, 3)), [0, 0, 2.0], [1, 1.1, 0.9])
    return points, camera.project(pose.apply(points)) + rng.normal(0, 1, (20, 2))
