"""Keypoints that a detector did not find are no measurements, whatever their score."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cadalign import View, fit
from cadalign.datasets import (
    ImageKeypoints,
    ModelKeypoint,
    ModelKeypoints,
    join_keypoints,
    read_image_keypoints,
)
from cadalign.errors import DataError, InputError
from cadalign.evaluation.simulation import simulate_problem
from cadalign.geometry.pixels import missing_pixels
from cadalign.io.observation import Observation

COUNT, FOUND = 17, 7
PROBLEM = simulate_problem(np.random.default_rng(3), points=COUNT, noise_px=0.5)
NAMES = [f"k{row}" for row in range(COUNT)]
MODEL = ModelKeypoints(
    tuple(
        ModelKeypoint(name, tuple(xyz))
        for name, xyz in zip(NAMES, PROBLEM.points_3d.tolist(), strict=True)
    )
)
SCORES = [0.95] * FOUND + np.linspace(0.06, 0.69, COUNT - FOUND).tolist()
NOT_FOUND = [(0.0, 0.0), (-1.0, -1.0), (None, None), (float("nan"), float("nan")), (99.5, 80.0)]


def pixels_with(placeholder: tuple[Any, Any]) -> list[list[Any]]:
    """Pixels; the first seven were found."""
    return [*PROBLEM.points_2d[:FOUND].tolist(), *([list(placeholder)] * (COUNT - FOUND))]


def ultralytics(pixels: list[list[Any]]) -> Any:
    x, y = zip(*pixels, strict=True)
    return [{"confidence": 0.9, "keypoints": {"x": x, "y": y, "visible": SCORES}}]


def coco_results(pixels: list[list[Any]]) -> Any:
    flat = [value for row, score in zip(pixels, SCORES, strict=True) for value in (*row, score)]
    return [{"image_id": 1, "category_id": 1, "keypoints": flat, "score": 0.9}]


def csv(pixels: list[list[Any]]) -> str:
    words = {None: "null"}
    rows = zip(NAMES, pixels, SCORES, strict=True)
    lines = [f"{name},{words.get(u, u)},{words.get(v, v)},{score}" for name, (u, v), score in rows]
    return "\n".join(["name,u,v,score", *lines])


def observation(pixels: list[list[Any]]) -> Any:
    rows = zip(NAMES, PROBLEM.points_3d.tolist(), pixels, SCORES, strict=True)
    keypoints = [{"name": n, "xyz": xyz, "uv": uv, "score": s} for n, xyz, uv, s in rows]
    return {"camera": PROBLEM.camera.to_dict(), "keypoints": keypoints}


@pytest.mark.parametrize("placeholder", NOT_FOUND, ids=str)
@pytest.mark.parametrize("form", [ultralytics, coco_results, csv, observation])
def test_keypoints_not_found_are_left_out_and_counted(
    tmp_path: Path, form: Any, placeholder: tuple[Any, Any]
) -> None:
    content = form(pixels_with(placeholder))
    path = tmp_path / ("found.csv" if form is csv else "found.json")
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    if form is observation:
        seen = Observation.load(path)
    else:
        (found,) = read_image_keypoints(path)
        assert found.is_found.tolist() == [True] * FOUND + [False] * (COUNT - FOUND)
        seen = join_keypoints(found, MODEL, PROBLEM.camera)
    assert seen.not_found == tuple(range(FOUND, COUNT))
    assert seen.text_of_not_found.startswith(f"{COUNT - FOUND} of {COUNT} keypoints are not found")
    assert seen.names == tuple(NAMES[:FOUND])
    np.testing.assert_allclose(seen.points_3d, PROBLEM.points_3d[:FOUND])
    alone = fit(PROBLEM.points_3d[:FOUND], PROBLEM.points_2d[:FOUND], PROBLEM.camera)
    result = fit(seen.points_3d, seen.points_2d, seen.camera)
    np.testing.assert_allclose(result.alignment.translation, alone.alignment.translation)


def test_measurements_are_kept() -> None:
    """Two keypoints may meet at a pixel, one coordinate may be 0, and a small image is crowded."""
    usual = np.array([[0.0, 20.0], [30, 0], [50, 60], [50, 60], [90, 10], [-1, 4]])
    assert not missing_pixels(usual).any()
    assert not missing_pixels(np.array([[5.0, 5], [5, 5], [5, 5], [9, 9]])).any()
    assert missing_pixels(np.array([[0.0, 0.0], [50, 60]])).tolist() == [False, False]


def test_one_placeholder_of_a_detector_is_enough() -> None:
    found = ImageKeypoints(np.array([[0.0, 0.0], [50, 60]]), scores=np.array([0.4, 0.9]))
    assert found.is_found.tolist() == [False, True]


def test_half_of_a_pixel_is_refused() -> None:
    with pytest.raises(DataError, match=r"keypoint 1 has the invalid pixel \[nan, 4\.0\]"):
        ImageKeypoints(np.array([[1.0, 2], [np.nan, 4]]))


def test_sigmas_stay_with_their_keypoints() -> None:
    data = observation(pixels_with((0, 0))) | {"fit": {"sigma": list(range(1, COUNT + 1))}}
    assert Observation.from_dict(data).fit_options["sigma"] == list(range(1, FOUND + 1))


@pytest.mark.parametrize(
    "call",
    [lambda uv: fit(PROBLEM.points_3d, uv, PROBLEM.camera), lambda uv: View(PROBLEM.camera, uv)],
    ids=["fit", "view"],
)
def test_functions_refuse_placeholders_by_their_rows(call: Callable[[np.ndarray], Any]) -> None:
    pixels = np.array(pixels_with((0, 0)))
    with pytest.raises(InputError, match=r"10 keypoints, rows 7, 8, .* at exactly \(0, 0\)"):
        call(pixels)


def test_flags_are_read_one_way_in_a_whole_file(tmp_path: Path) -> None:
    ones, mixed = [1] * COUNT, [2] * 9 + [1] * 8
    path = tmp_path / "found.json"
    rows = PROBLEM.points_2d.tolist()
    for flags, expected in (([ones, mixed], 0.5), ([ones, ones], 1.0)):
        of_objects = [np.column_stack([rows, each]).ravel().tolist() for each in flags]
        path.write_text(json.dumps([{"keypoints": flat} for flat in of_objects]))
        first, _ = read_image_keypoints(path)
        assert first.scores is not None
        assert first.scores.tolist() == [expected] * COUNT
