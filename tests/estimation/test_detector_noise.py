"""Calibrated noise of a detector: recovered from synthetic errors, stored, used in estimates."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.problems import problem_of

from cadalign import DetectorNoise, ShapeModel, View, align, calibrate_detector
from cadalign.cli import main
from cadalign.datasets import ImageKeypoints
from cadalign.datasets import open as open_data
from cadalign.datasets.photos.kitti_keypoints import car_keypoints, car_shape, yaw_of_car
from cadalign.errors import CadalignError, DataError, InputError

NAMES = ("a", "b", "c", "d", "e", "f")


def synthetic(
    rng: np.random.Generator,
    count: int,
    *,
    outliers: float = 0.0,
    by_size: bool = False,
    shared: float = 0.0,
    own: float = 0.0,
    by_score: bool = True,
) -> tuple[list[ImageKeypoints], list[ImageKeypoints]]:
    """Predictions and truths; errors of 6 px at score 0 and 1.5 px at score 1, "f" half as much."""
    predictions, truths = [], []
    for _ in range(count):
        size = float(np.exp(rng.uniform(4, 6)))
        points = rng.uniform(0, size, (6, 2)) + 300
        scores = rng.uniform(0.01, 1, 6)
        sigma = 6 * 0.25**scores if by_score else np.full(6, 3.0)
        sigma = sigma * np.where(np.array(NAMES) == "f", 0.5, 1.0) * (size / 150 if by_size else 1)
        errors = np.sqrt(1 - shared) * rng.normal(0, 1, (6, 2))
        errors = (errors + np.sqrt(shared) * rng.normal(0, 1, 2)) * sigma[:, None]
        wrong = rng.uniform(size=6) < outliers
        errors[wrong] = rng.uniform(-0.7 * size, 0.7 * size, (int(wrong.sum()), 2))
        seen = points + errors + own * rng.normal(0, 1, (6, 2))
        predictions.append(ImageKeypoints(seen, scores, names=NAMES))
        truths.append(ImageKeypoints(points, names=NAMES, sigma=np.full(6, own) if own else None))
    return predictions, truths


def test_noise_by_score_and_keypoint_is_recovered() -> None:
    noise = calibrate_detector(*synthetic(np.random.default_rng(0), 800))
    found = noise.sigma(np.zeros((3, 2)), scores=[0.1, 0.5, 0.9], ids=["a", "b", "f"])
    np.testing.assert_allclose(found, [6 * 0.25**0.1, 3.0, 3 * 0.25**0.9], rtol=0.12)
    assert noise.unit == "px"
    assert noise.outliers < 0.01
    assert abs(noise.correlation) < 0.05
    assert noise.count == 4800


def test_outliers_correlation_and_size_are_recovered() -> None:
    rng = np.random.default_rng(1)
    noise = calibrate_detector(*synthetic(rng, 600, outliers=0.15))
    assert noise.outliers == pytest.approx(0.15, abs=0.04)
    assert noise.sigma(np.zeros((1, 2)), scores=[0.5])[0] == pytest.approx(3.0, rel=0.2)
    assert calibrate_detector(*synthetic(rng, 600, shared=0.5)).correlation == pytest.approx(
        0.5, abs=0.08
    )
    noise = calibrate_detector(*synthetic(rng, 600, by_size=True))
    assert noise.unit == "size"


def test_noise_of_the_truth_is_taken_off() -> None:
    given = synthetic(np.random.default_rng(2), 800, own=3.0, by_score=False)
    noise = calibrate_detector(*given)
    assert noise.sigma(np.zeros((1, 2)), scores=[0.5], ids=["a"])[0] == pytest.approx(3, rel=0.1)


def test_scores_that_tell_nothing_leave_one_knot() -> None:
    noise = calibrate_detector(*synthetic(np.random.default_rng(3), 300, by_score=False))
    assert len(np.asarray(noise.scores)) == 1 or np.ptp(np.log(noise.sigmas)) < 0.15


def test_file_is_read_as_written(tmp_path: Path) -> None:
    noise = DetectorNoise([0.1, 0.7], [5.0, 1.5], "size", {"a": 1.25, 3: 0.5}, 0.02, 0.3, 77)
    noise.save(tmp_path / "detector.noise")
    again = DetectorNoise.open(tmp_path / "detector.noise")
    assert str(again) == str(noise)
    assert dict(again.factors) == dict(noise.factors)
    data = json.loads((tmp_path / "detector.noise").read_text())
    data["knots"][0]["sigma"] = -1
    (tmp_path / "bad.noise").write_text(json.dumps(data))
    with pytest.raises(DataError) as refused:
        DetectorNoise.open(tmp_path / "bad.noise")
    assert f"{tmp_path / 'bad.noise'}: knots[0].sigma" in str(refused.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: DetectorNoise([0.2, 0.8], [2.0, 1.0]).sigma(np.zeros((1, 2))),
            "scores: the detector's noise depends on the scores, which are missing; give the "
            "keypoints' scores",
        ),
        (lambda: DetectorNoise([0.8, 0.2], [2.0, 1.0]), "scores: do not rise"),
        (lambda: DetectorNoise([0.5, 0.5], [2.0, 1.0]), "scores: do not rise"),
        (
            lambda: calibrate_detector([ImageKeypoints(np.zeros((2, 2)))], []),
            "truth: 0 objects, but 1 predictions; give the same objects in the same order",
        ),
        (
            lambda: calibrate_detector(*[[ImageKeypoints(np.zeros((2, 2)))]] * 2),
            "predictions: 2 keypoints are too few; give at least 20",
        ),
    ],
)
def test_refusals(call: Any, message: str) -> None:
    with pytest.raises(InputError) as refused:
        call()
    assert str(refused.value) == message


def observation_file(folder: Path) -> Path:
    problem = problem_of(1, points=10)
    keypoints = [
        {"xyz": xyz, "uv": uv, "confidence": 0.1 + 0.08 * k, "name": f"k{k}"}
        for k, (xyz, uv) in enumerate(
            zip(problem.points_3d.tolist(), problem.points_2d.tolist(), strict=True)
        )
    ]
    path = folder / "seen.json"
    path.write_text(json.dumps({"camera": problem.camera.to_dict(), "keypoints": keypoints}))
    return path


def test_a_fit_and_a_view_take_the_noise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = observation_file(tmp_path)
    noise = DetectorNoise([0.1, 0.9], [3.0, 0.5], factors={"k3": 4.0})
    noise.save(tmp_path / "detector.noise")
    command = ["fit", str(path), "--json", "--no-picture", "--out", str(tmp_path / "out")]
    assert main([*command, "--noise", str(tmp_path / "detector.noise")]) == 0
    with_noise = json.loads(capsys.readouterr().out)
    assert main(command) == 0
    without = json.loads(capsys.readouterr().out)
    assert with_noise["fisher_covariance"] != without["fisher_covariance"]
    data = json.loads(path.read_text())["keypoints"]
    view = View(
        problem_of(1).camera,
        [each["uv"] for each in data],
        ids=[each["name"] for each in data],
        scores=[each["confidence"] for each in data],
        noise=noise,
    )
    expected = 3.0 * (0.5 / 3.0) ** (np.arange(10) / 10.0)
    expected[3] *= 4
    np.testing.assert_allclose(view.sigma, expected)
    for option in (["--sigma", "2"], ["--similar"]):
        assert main([*command, "--noise", str(tmp_path / "detector.noise"), *option]) != 0
        assert f"--noise has the standard deviations, which {option[0]} gives" in (
            capsys.readouterr().err
        )


# Real keypoints -----------------------------------------------------------------------------------

CARS = Path(os.environ.get("CADALIGN_DATA", "/nonexistent")) / "real" / "kitti_cars"


def yaw_error(model: ShapeModel, view: View, true_yaw: float) -> tuple[float, bool]:
    """Error of yaw [deg], and if the 95 % region holds the truth."""
    result = align(model, view)
    forward = -result.alignment.rotation[:, 1]
    moved = np.cross(np.eye(3), forward)  # by a turn about each axis
    slope = (moved[:, 0] * forward[2] - moved[:, 2] * forward[0]) / (forward[[0, 2]] ** 2).sum()
    std = float(np.sqrt(slope @ result.covariance[:3, :3] @ slope))
    error = np.arctan2(
        *[f(yaw_of_car(result.alignment.rotation) - true_yaw) for f in (np.sin, np.cos)]
    )
    return abs(float(np.degrees(error))), bool(abs(error) < result.radius(0.95) * std)


@pytest.mark.skipif(not CARS.is_dir(), reason="CADALIGN_DATA has no cars of KITTI")
def test_calibrated_noise_states_the_yaw_of_cars_honestly() -> None:
    model = car_shape(CARS)
    assert model is not None
    seen, true, given = [], [], []
    for photo in open_data(CARS):
        for car in photo.objects:
            if car.keypoints is None or car.keypoints.scores is None:
                continue
            scores = np.where(car.keypoints.scores >= 0.1, car.keypoints.scores, 0.0)
            seen.append(ImageKeypoints(car.keypoints.points_2d, scores, names=car.keypoints.names))
            true.append(car_keypoints(model, car.truth.box, photo.camera))
            given.append((photo.camera, car.truth.box))
    block = np.arange(len(seen)) // 6  # frames of a track are alike
    rows: dict[str, list[tuple[float, bool]]] = {"3 px": [], "calibrated": [], "left out": []}
    noise = calibrate_detector(seen, true)
    others = {
        k: calibrate_detector(
            [each for each, b in zip(seen, block, strict=True) if b != k],
            [each for each, b in zip(true, block, strict=True) if b != k],
        )
        for k in set(block.tolist())
    }
    for each, (camera, box), k in zip(seen, given, block.tolist(), strict=True):
        kept = np.flatnonzero(each.scores > 0)
        if len(kept) < 6:
            continue
        ids = [each.names[row] for row in kept]
        fields: dict[str, Any] = {"ids": ids, "scores": each.scores[kept]}
        ways = ({"sigma": 3.0}, {"noise": noise}, {"noise": others[k]})
        for name, way in zip(rows, ways, strict=True):
            view = View(camera, each.points_2d[kept], **fields, **way)
            try:
                rows[name].append(yaw_error(model, view, yaw_of_car(box.rotation)))
            except CadalignError:
                continue
    held = {name: np.mean([each[1] for each in found]) for name, found in rows.items()}
    median = {name: np.median([each[0] for each in found]) for name, found in rows.items()}
    assert held["3 px"] < 0.9
    assert 0.9 <= held["calibrated"] <= 0.98
    assert held["left out"] >= 0.87
    assert median["calibrated"] <= median["3 px"]
    assert noise.correlation > 0.4
