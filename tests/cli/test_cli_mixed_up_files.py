"""Mixed-up files and folders are refused in one line that names their kind."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.files import TETRAHEDRON
from support.refusals import refusal_line

from cadalign.cli import main
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import write_image
from cadalign.io.observation import Observation

PROBLEM = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
NAMES = [f"corner {row}" for row in range(10)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with an observation, a mesh, a photo and keypoint files of both."""
    monkeypatch.chdir(tmp_path)
    model, camera = Path("model.obj"), PROBLEM.camera
    model.write_text(TETRAHEDRON)
    Path("model.ply").write_bytes(b"ply\n\x9a\xff")
    write_image(Path("photo.png"), np.zeros((camera.height, camera.width, 3), np.uint8))
    seen = Observation(PROBLEM.points_3d, PROBLEM.points_2d, camera, model=model.absolute())
    seen.save(Path("seen.json"))
    points = [
        {"name": name, "xyz": xyz}
        for name, xyz in zip(NAMES, PROBLEM.points_3d.tolist(), strict=True)
    ]
    named = {"format": "cadalign model keypoints", "version": 1, "keypoints": points}
    Path("model.keypoints.json").write_text(json.dumps(named))
    flat = [value for u, v in PROBLEM.points_2d.tolist() for value in (u, v, 2)]
    size = {"width": camera.width, "height": camera.height}
    found = {
        "images": [{"id": 1, "file_name": "elsewhere.jpg", **size}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "keypoints": flat}],
        "categories": [{"id": 1, "name": "object", "keypoints": NAMES}],
    }
    Path("found.json").write_text(json.dumps(found))
    return tmp_path


@pytest.mark.parametrize("command", ["fit", "retrieve --library none.library"])
@pytest.mark.parametrize("mesh", ["model.obj", "model.ply"])
def test_mesh_is_no_observation(
    folder: Path, mesh: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *options = command.split()
    line = refusal_line(capsys, name, mesh, *options)
    assert line.startswith(f"{mesh}: a mesh, not an observation")
    assert f"cadalign annotate PHOTO {mesh}" in line


def test_observation_and_fit_are_told_apart(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refusal_line(capsys, "export", "seen.json", "--to", "x.glb")
    assert line.startswith("seen.json: an observation, not the result of a fit; fit it first")
    assert main(["fit", "seen.json"]) == 0
    capsys.readouterr()
    line = refusal_line(capsys, "fit", "seen_fit/fit.json")
    fix = "give the observation that was fitted"
    assert line == f"seen_fit/fit.json: the result of a fit, not an observation; {fix}"


@pytest.mark.parametrize("out", [".", "..", "/", "", "sub"])
def test_folder_is_no_file_to_write(
    folder: Path, sample_root: Path, out: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("sub").mkdir()
    assert main(["fit", "seen.json", "--no-picture"]) == 0
    capsys.readouterr()
    before = sorted(folder.rglob("*"))
    for command in (
        ["library", "build", str(sample_root), "--out"],
        ["shape", "learn", str(sample_root), "--category", "chair", "--out"],
        ["observe", "found.json", "model.keypoints.json", "--out"],
        ["report", "none", "--out"],
    ):
        line = refusal_line(capsys, *command, out)
        assert line == f"{out or '.'}: is a folder; give a file's name"
    assert sorted(folder.rglob("*")) == before


def test_present_folder_is_fitted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = folder / "here"
    here.mkdir()
    (folder / "seen.json").rename(here / "seen.json")
    monkeypatch.chdir(here)
    assert main(["fit", ".", "--no-picture"]) == 0
    assert (folder / "here_fit" / "results.csv").is_file()


def test_keypoints_of_the_model_are_none_of_a_photo(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refusal_line(capsys, "observe", "model.keypoints.json", "found.json")
    what = "keypoints of a model, not a detector's keypoints"
    assert line.startswith(f"model.keypoints.json: {what}; ")


def test_another_name_of_the_photo_is_said(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["observe", "found.json", "model.keypoints.json", "--image", "photo.png"]) == 0
    said = capsys.readouterr().err
    assert "found.json names the photo elsewhere.jpg; its keypoints are used for photo.png" in said


def test_unknown_field_is_answered_by_fields(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = json.loads(Path("seen.json").read_text())
    Path("typo.json").write_text(json.dumps(data | {"up_axs": "y"}))
    line = refusal_line(capsys, "fit", "typo.json")
    assert "unknown field 'up_axs', did you mean 'up_axis'?; known are cam_from_rig, " in line
    assert "camera_height, " in line
    assert "--" not in line


def test_folder_is_no_mesh(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "a folder, not a mesh file" in refusal_line(capsys, "render", folder)


def test_exchanged_arguments_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["annotate", "model.obj", "photo.png", "--no-open"])
    text = "PHOTO MODEL: model.obj is a mesh and photo.png is a photo: swap them"
    assert text in capsys.readouterr().err
