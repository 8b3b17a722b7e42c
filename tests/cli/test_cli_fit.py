"""`cadalign fit`: its output, its files, and errors in one line."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.files import TETRAHEDRON
from support.refusals import refusal_line
from support.scenes import CAMERA, LOOK, keypoints

from cadalign import Alignment, Result, fit
from cadalign.cli import main
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.io.observation import Observation
from cadalign.render.layers import REPROJECTED_COLOR

PROBLEM = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
SIGMA = np.linspace(0.2, 5, 10)
STORED = {"sigma": 3.0, "loss": "cauchy", "stretch": "y", "stretch_sigma": 0.3}


def write_observation(path: Path, problem: SimulatedProblem = PROBLEM, **fields: Any) -> Path:
    Observation(problem.points_3d, problem.points_2d, problem.camera, **fields).save(path)
    return path


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    return path


def colors_in(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture[..., ::-1].reshape(-1, 3).astype(int)


def has_color(path: Path, color: tuple[int, int, int]) -> bool:
    return bool((np.abs(colors_in(path) - color).max(axis=1) < 12).any())


# --- what it does ----------------------------------------------------------------------------


def test_prints_the_summary_and_writes_fit_and_overlay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_observation(tmp_path / "chair.json")
    assert main(["fit", str(path)]) == 0
    captured = capsys.readouterr()
    expected = fit(PROBLEM.points_3d, PROBLEM.points_2d, PROBLEM.camera)
    assert captured.out == f"{expected}\n"
    out = tmp_path / "chair_fit"
    assert sorted(entry.name for entry in out.iterdir()) == ["fit.json", "overlay.png"]
    written = Result.load(out / "fit.json")
    assert written.alignment == expected.alignment
    assert str(written) == str(expected)
    overlay = cv2.imread(str(out / "overlay.png"))
    assert overlay.shape == (480, 640, 3)
    assert has_color(out / "overlay.png", (240, 50, 50))  # the predicted box


def test_json_goes_to_standard_output_and_nothing_else_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_observation(tmp_path / "chair.json")
    assert main(["fit", str(path), "--json", "--out", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr()
    data = json.loads(captured.out)
    assert data == json.loads((tmp_path / "out" / "fit.json").read_text())
    assert data["method"] == "optimal"
    assert len(data["views"][0]["residuals"]) == 10


@pytest.mark.parametrize(
    ("stored", "flags", "options"),
    [
        (STORED, [], STORED),
        (STORED, ["--sigma", "2", "--stretch", "z"], STORED | {"sigma": 2.0, "stretch": "z"}),
        ({"sigma": None}, [], {"sigma": None}),  # which has no prior of its own
        ({"sigma": 3.0}, ["--sigma", "none"], {"sigma": None}),
        ({}, ["--similar", "--sigma", "2"], {"sigma": 2.0, "stretch_sigma": 0.2}),
        ({}, ["--similar"], {"sigma": None, "stretch_sigma": 0.2}),
        ({"stretch_sigma": 0.1}, ["--similar"], {"sigma": None, "stretch_sigma": 0.1}),
        ({}, ["--similar", "--stretch", "none"], {"sigma": None, "stretch": "none"}),
        ({}, [], {"sigma": SIGMA}),
    ],
)
def test_options_are_those_of_the_command_or_of_the_file(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    stored: dict[str, Any],
    flags: list[str],
    options: dict[str, Any],
) -> None:
    path = write_observation(tmp_path / "chair.json", sigma=SIGMA, fit_options=stored)
    assert main(["fit", str(path), *flags]) == 0
    expected = fit(PROBLEM.points_3d, PROBLEM.points_2d, PROBLEM.camera, **options)
    assert capsys.readouterr().out == f"{expected}\n"


def test_wrong_stored_options_name_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_observation(tmp_path / "chair.json", fit_options={"stretch": "x"})
    message = refusal_line(capsys, "fit", str(path))
    assert message.startswith(f"{path}: fit.stretch: unknown stretch 'x'; known are yz, y, z, none")


def test_a_rejected_keypoint_behind_the_camera_is_written_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    behind = np.array([[0.0, 0.0, -100.0]])
    points_3d = np.vstack([behind @ PROBLEM.alignment.linear, PROBLEM.points_3d])
    points_2d = np.vstack([[[100.0, 100.0]], PROBLEM.points_2d])
    problem = SimulatedProblem(points_3d, points_2d, PROBLEM.camera, PROBLEM.alignment, None)
    path = write_observation(tmp_path / "chair.json", problem)
    assert main(["fit", str(path), "--robust"]) == 0
    text = (tmp_path / "chair_fit" / "fit.json").read_text()
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    read = Result.from_dict(json.loads(text))
    assert read.inliers.tolist() == [False] + [True] * 10
    assert np.isposinf(read.residuals[0]).all()
    assert np.isfinite(read.residuals[1:]).all()
    assert capsys.readouterr().out == f"{read}\n"
    overlay = tmp_path / "chair_fit" / "overlay.png"
    assert has_color(overlay, REPROJECTED_COLOR)


def test_photo_and_model_are_drawn(tmp_path: Path) -> None:
    blue = np.full((480, 640, 3), (200, 90, 40), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), blue)
    (tmp_path / "model.obj").write_text(TETRAHEDRON)
    path = write_observation(tmp_path / "chair.json", image=tmp_path / "photo.png")
    edit(path, lambda data: data.update(model="model.obj"))
    assert main(["fit", str(path)]) == 0
    picture = tmp_path / "chair_fit" / "overlay.png"
    assert has_color(picture, (40, 90, 200))
    assert has_color(picture, (240, 50, 50))


# --- what it refuses -------------------------------------------------------------------------


def test_the_photo_is_not_drawn_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = tmp_path / "overlay.png"
    cv2.imwrite(str(photo), np.zeros((480, 640, 3), dtype=np.uint8))
    before = photo.read_bytes()
    (tmp_path / "model.obj").write_text(TETRAHEDRON)
    path = write_observation(tmp_path / "chair.json", image=photo, model=tmp_path / "model.obj")
    line = refusal_line(capsys, "fit", path, "--out", tmp_path)
    assert line == f"{photo}: this file is an input and would be overwritten; give another name"
    assert photo.read_bytes() == before


def test_missing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "nothing.json"
    assert refusal_line(capsys, "fit", str(path)) == f"{path}: no such file"
    for name in ("a" * 300, "a" * 300 + ".json", "a" * 300 + ".jsonl"):
        line = refusal_line(capsys, "fit", name)
        assert line == f"{name}: cannot be read (File name too long)"


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (
            ["--sigma", "0"],
            "--sigma: 0.0 is not a positive number",
        ),
        (
            ["--method", "best"],
            "--method: unknown method 'best'; known are optimal, aepnp, aepnp-paper, epnp",
        ),
    ],
)
def test_wrong_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], text: str
) -> None:
    path = write_observation(tmp_path / "chair.json")
    assert refusal_line(capsys, "fit", path, *flags) == text


def test_photo_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = tmp_path / "photo.png"
    path = write_observation(tmp_path / "chair.json", image=photo)
    assert refusal_line(capsys, "fit", path) == f"{photo}: no such file"
    photo.write_text("not a picture")
    line = refusal_line(capsys, "fit", path)
    assert line.startswith(f"{photo}: not an image that can be read (")
    cv2.imwrite(str(photo), np.zeros((10, 20, 3), dtype=np.uint8))
    assert refusal_line(capsys, "fit", path) == (
        f"{photo}: the image has 20 x 10 pixels, but its camera has 640 x 480; "
        "give keypoints, photo and camera of the same image"
    )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "fit"),
        (["fit"], "OBSERVATION: no observation is given"),
        (["fit", "a.json", "--nonsense"], "--nonsense"),
        (["align", "a.json"], "align"),
        (["annotate", "photo.jpg"], "MODEL"),
    ],
)
def test_wrong_command_lines_exit_with_2(
    arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert text in said
    assert "Traceback" not in said


# --- as a process ----------------------------------------------------------------------------


def run_process(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).with_name("cadalign")
    command = [str(program), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.long
def test_installed_command_runs_and_refuses(tmp_path: Path) -> None:
    path = write_observation(tmp_path / "chair.json")
    done = run_process("fit", str(path), "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["method"] == "optimal"
    refused = run_process("fit", str(tmp_path / "nothing.json"))
    assert refused.returncode == 1
    assert refused.stdout == ""
    assert refused.stderr == f"cadalign: {tmp_path / 'nothing.json'}: no such file\n"


def test_no_other_size_is_supposed_of_a_photo_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points, photo, path = keypoints(12, seed=3), tmp_path / "photo.png", tmp_path / "half.json"
    pixels = CAMERA.project(Alignment(LOOK, [0.05, -0.02, 1.5], np.ones(3)).apply(points))
    cv2.imwrite(str(photo), np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    said = []
    for image in (None, photo):
        Observation(points, pixels / 2, CAMERA, image=image).save(path)
        assert main(["fit", str(path)]) == 0
        said.append("are of images of 320 x 240 px" in "".join(capsys.readouterr()))
    assert said == [True, False]
