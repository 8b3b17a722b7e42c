"""`cadalign fit` of many files and of a detector's file, its options, and messages."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cadalign import Alignment, Camera, Result, Results, __version__
from cadalign.cli import main
from cadalign.datasets import ModelKeypoint, ModelKeypoints
from cadalign.io.observation import Observation

CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
POINTS = np.random.default_rng(1).uniform(-1, 1, (8, 3))
POSES = [Alignment(np.eye(3), [0.1 * k, 0, 6.0], [1, 1.2, 0.8]) for k in range(3)]
NAMES = [f"corner {n}" for n in range(8)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A COCO file of three objects in two photos, the model's keypoints, and a matrix K."""
    entries = []
    for number, pose in enumerate(POSES):
        seen = CAMERA.project(pose.apply(POINTS))
        flat = np.column_stack([seen, np.ones(8)]).ravel().tolist()
        entries.append({"image_id": 1 + number // 2, "category_id": 1, "keypoints": flat})
    images = [
        {"id": 1, "file_name": "a.png", "width": 640, "height": 480},
        {"id": 2, "file_name": "b.png", "width": 640, "height": 480},
    ]
    names = [{"id": 1, "name": "thing", "keypoints": NAMES}]
    data = {"images": images, "annotations": entries, "categories": names}
    for number, entry in enumerate(entries):
        entry["id"] = number
        entry["num_keypoints"] = 8
    (tmp_path / "found.json").write_text(json.dumps(data))
    rows = zip(NAMES, POINTS.tolist(), strict=True)
    keypoints = tuple(ModelKeypoint(name, tuple(xyz)) for name, xyz in rows)
    ModelKeypoints(keypoints).save(tmp_path / "model.keypoints.json")
    np.savetxt(tmp_path / "K.txt", CAMERA.matrix)
    Image.new("RGB", (640, 480)).save(tmp_path / "a.png")
    return tmp_path


def write_observations(folder: Path) -> Path:
    """Write an observation of each object into a folder."""
    out = folder / "seen"
    out.mkdir()
    for name, image, pose in zip(("a_0", "a_1", "b"), ("a.png", "a.png", None), POSES, strict=True):
        seen = Observation(POINTS, CAMERA.project(pose.apply(POINTS)), CAMERA)
        seen = replace(seen, image=None if image is None else folder / image)
        seen.save(out / f"{name}.json")
    return out


@pytest.mark.slow
def test_every_observation_of_a_folder_is_fitted(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = write_observations(folder)
    (written / "broken.json").write_text("{")
    (written / "notes.json").write_text("{}")
    assert main(["fit", str(written)]) == 3
    text = capsys.readouterr().err
    assert f"failed 1: {written / 'broken.json'}, line 1: not valid JSON" in text
    assert "3 of 4 aligned, 1 failed: " in text
    out = folder / "seen_fit"
    with (out / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = ["a_0.json", "a_1.json", "b.json", "broken.json"]
    assert [Path(row["source"]).name for row in rows] == names
    assert [row["status"] for row in rows] == ["ok", "ok", "ok", "failed"]
    for found, pose in zip(Results.open(out), POSES, strict=False):
        np.testing.assert_allclose(found.alignment.scale, pose.scale, atol=1e-4)
    assert sorted(path.name for path in (out / "thumbs").iterdir()) == [
        "no model_a.png, row 0.webp",
        "no model_a.png, row 1.webp",
    ]
    assert "broken.json, row 3" in (out / "report.html").read_text()


def test_a_detectors_file_needs_no_observations(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera, model = ["--camera", str(folder / "K.txt")], str(folder / "model.obj")  # beside it
    out = ["--out", str(folder / "out"), "--no-picture"]
    assert main(["fit", str(folder / "found.json"), *camera, "--model", model, *out]) == 0
    results = Results.open(folder / "out")
    for found, pose in zip(results, POSES, strict=True):
        np.testing.assert_allclose(found.alignment.scale, pose.scale, atol=1e-4)
    rows = list(csv.DictReader((folder / "out" / "results.csv").open()))
    assert [Path(row["image"]).name for row in rows] == ["a.png", "a.png", ""]
    assert rows[1]["source"].endswith("found.json: annotations[1]")
    capsys.readouterr()
    assert main(["fit", str(folder / "found.json"), *camera, *out]) == 1
    assert "--model: a detector's file needs a model; give the" in capsys.readouterr().err


def test_a_camera_that_cannot_be_read_is_refused_before_the_run(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "K.txt").write_text("1 2 3")
    model = ["--model", str(folder / "model.keypoints.json"), "--out", str(folder / "out")]
    camera = ["--camera", str(folder / "K.txt")]
    assert main(["fit", str(folder / "found.json"), *camera, *model]) == 1
    assert f"{folder / 'K.txt'}: not a calibration matrix; give" in capsys.readouterr().err
    assert not (folder / "out").exists()


def test_matrix_takes_the_place_of_the_camera(folder: Path) -> None:
    path = write_observations(folder) / "b.json"
    np.savetxt(folder / "K.txt", CAMERA.matrix * [[1.1], [1.1], [1]])
    assert main(["fit", str(path), "--camera", str(folder / "K.txt")]) == 0
    camera = Result.load(path.with_name("b_fit") / "fit.json").camera
    assert camera.fx == pytest.approx(770)
    assert camera.cx == pytest.approx(1.1 * 319.5)


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("--min-score 0.5", "--min-score: has no effect on one observation; leave it out"),
        ("--workers 2", "--workers: has no effect on one observation; leave it out"),
    ],
)
def test_options_without_effect_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, text: str
) -> None:
    path = tmp_path / "p0.json"
    Observation(POINTS, CAMERA.project(POSES[0].apply(POINTS)), CAMERA).save(path)
    assert main(["fit", str(path), *option.split()]) == 1
    assert capsys.readouterr().err == f"cadalign: {text}\n"
    assert not path.with_name("p0_fit").exists()


def test_reasons_of_failures_name_the_options(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "few.keypoints.json"
    ModelKeypoints((ModelKeypoint("corner 0", (0.0, 0.0, 0.0)),)).save(path)
    arguments = ["--camera", str(folder / "K.txt"), "--model", str(path), "--no-picture"]
    assert main(["fit", str(folder / "found.json"), *arguments]) == 1
    said = capsys.readouterr().err
    assert "it has corner 0; --ignore-unknown leaves out unknown keypoints\n" in said


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"cadalign {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            ["fit", "{folder}/a.png"],
            "{folder}/a.png: a photo, not an observation; mark keypoints with `cadalign annotate "
            "a.png MODEL`, which writes one, or use a detector's with `cadalign observe`",
        ),
        (["fit", "{folder}/empty"], "{folder}/empty: the folder holds no observation; "),
        (
            ["observe", "{folder}/found.json", "{folder}/model.keypoints.json", "--image", "a.png"],
            "--object: the image has 2 objects, and no scores to choose by; choose one, 0 to 1",
        ),
        (
            ["observe", "{folder}/found.json", "{folder}/other.keypoints.json", "--image", "b.png"],
            "{folder}/found.json: annotations[2]: the model has no keypoint 'corner 4'; "
            "it has corner 0, corner 1, corner 2, corner 3; --ignore-unknown leaves out "
            "unknown keypoints",
        ),
    ],
)  # fmt: skip
def test_messages_name_what_the_user_typed(
    folder: Path,
    arguments: list[str],
    text: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir()
    Image.new("RGB", (640, 480)).save(folder / "b.png")
    model = ModelKeypoints.load(folder / "model.keypoints.json")
    ModelKeypoints(model.keypoints[:4]).save(folder / "other.keypoints.json")
    assert main([word.format(folder=folder) for word in arguments]) == 1
    shown = capsys.readouterr().err
    assert text.format(folder=folder) in shown
