"""What goes wrong around a run: disks that fill, folders that cannot be written, wrong records.

Each is a row, or one clear line, and nothing that was done is lost.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from support.forked import MAIN, Program

from cadalign import Camera, Observation
from cadalign.batch import FitRunOptions, ObservationFit, run_many
from cadalign.cli import main
from cadalign.datasets import ModelKeypoint, ModelKeypoints
from cadalign.evaluation.runs.engine import Progress
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import write_image

CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
POINTS = np.random.default_rng(1).uniform(-1, 1, (8, 3))
PIXELS = CAMERA.project(POINTS + [0.1, 0.2, 6.0])
# The system refuses what exceeds it, as a full disk does.
LIMITED = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000)); {MAIN}"


def lines(path: Path, count: int, **fields: Any) -> Path:
    """Write JSON lines of noisy observations with changed fields."""
    rng, texts = np.random.default_rng(0), []
    for _ in range(count):
        seen = Observation(POINTS, PIXELS + rng.normal(0, 1, PIXELS.shape), CAMERA)
        data = seen.to_dict() | fields
        given = {name: value for name, value in data.items() if value is not None}
        texts.append(json.dumps(given) + "\n")
    path.write_text("".join(texts))
    return path


def rows_of(run: Path) -> list[dict[str, Any]]:
    return pq.read_table(run / "results.parquet").to_pylist()


def test_a_full_disk_is_one_line_and_the_run_goes_on(
    tmp_path: Path,
) -> None:
    source = lines(tmp_path / "o.jsonl", 640)
    run = RunFolder(tmp_path / "run")
    arguments = ["fit", str(source), "--no-picture", "--out", str(run.path), "--workers", "0"]

    ended = Program(LIMITED, *arguments, "--method", "aepnp")
    _, told = ended.communicate()
    assert ended.poll() == 1
    (line,) = told.splitlines()
    assert "cannot be written (File too large); make room" in line
    done = len(list(run.parts.glob("???????.parquet")))
    assert done == 64
    seen: list[Progress] = []
    options = FitRunOptions(inputs=(source,), estimate=ObservationFit(method="aepnp"))
    run_many(options, run.path, workers=0, on_progress=seen.append)
    assert seen[0].done == 640
    assert {row["status"] for row in rows_of(run.path)} == {"ok"}


def test_a_folder_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = lines(tmp_path / "o.jsonl", 3)
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "run"
    assert main(["fit", str(source), "--out", str(out)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"cadalign: {out}: cannot be written (Not a directory); make room or choose another "
        "folder; what was written before is kept"
    )


def test_a_photo_that_cannot_be_read_is_a_warning_of_its_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.png").write_bytes(b"no photo")
    source = lines(tmp_path / "o.jsonl", 2, image="broken.png")
    assert main(["fit", str(source), "--out", str(tmp_path / "run")]) == 0
    said, counted = capsys.readouterr().err.splitlines()[:2]
    assert said == "2 with warnings: picture 2"
    assert counted.startswith("2 of 2 aligned, 0 failed: ")
    for row in rows_of(tmp_path / "run"):
        assert (row["warning_count"], row["warning_kinds"]) == (1, "picture")
        assert "the photo is not shown: " in row["warnings"]
        assert "broken.png" in row["warnings"]
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "; 2 with warnings: picture 2" in page


def test_a_wrong_model_name_is_a_warning_of_its_row_and_refused_for_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", (640, 480)).save(tmp_path / "a.png")
    source = lines(tmp_path / "o.jsonl", 1, image="a.png", model="gone.obj")
    assert main(["fit", str(source), "--out", str(tmp_path / "run")]) == 0
    (row,) = rows_of(tmp_path / "run")
    assert "the model is shown as a box: " in row["warnings"]
    assert "gone.obj" in row["warnings"]
    (tmp_path / "found.csv").write_text("image,name,x,y\na.png,one,1,2\n")
    capsys.readouterr()
    wrong = ["--model", str(tmp_path / "wrong.keypoints.json"), "--out", str(tmp_path / "x")]
    assert main(["fit", str(tmp_path / "found.csv"), *wrong]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"cadalign: {tmp_path / 'wrong.keypoints.json'}: no such file"
    assert not (tmp_path / "x").exists()


def test_no_page_is_written_over_what_it_is_made_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, run = lines(tmp_path / "o.jsonl", 1), tmp_path / "run"
    assert main(["fit", str(source), "--no-picture", "--out", str(run)]) == 0
    before = (run / "run.json").read_bytes()
    capsys.readouterr()
    assert main(["report", str(run), "--out", str(run / "run.json")]) == 1
    assert "run.json: this file is an input and would be overwritten" in capsys.readouterr().err
    assert (run / "run.json").read_bytes() == before


def test_photos_of_several_folders_are_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = np.column_stack([PIXELS, np.full(8, 0.9)]).ravel().tolist()
    named = [f"{place}/a.png" for place in ("left", "right", "elsewhere")]
    data = {
        "images": [{"id": k, "file_name": name} for k, name in enumerate(named)],
        "annotations": [{"image_id": k, "category_id": 1, "keypoints": flat} for k in range(3)],
        "categories": [],
    }
    source = tmp_path / "found.json"
    source.write_text(json.dumps(data))
    for place in ("left", "right"):
        (tmp_path / place).mkdir()
        Image.new("RGB", (640, 480)).save(tmp_path / place / "a.png")
    rows = detected(tmp_path, source)
    photos = [Path(row["image"]).relative_to(tmp_path).as_posix() for row in rows]
    assert photos == ["left/a.png", "right/a.png", "a.png"]
    given = ["--model", str(tmp_path / "model.keypoints.json"), "--images", str(tmp_path / "gone")]
    assert main(["fit", str(source), *given]) == 1
    assert "--images: " in capsys.readouterr().err


def coco(path: Path, *changes: dict[str, Any]) -> Path:
    """Write a detector's file with one object per change of fields."""
    flat = np.column_stack([PIXELS, np.full(8, 0.9)]).ravel().tolist()
    image = {"id": 1, "file_name": "a.png", "width": 640, "height": 480}
    entries = [{"image_id": 1, "category_id": 1, "keypoints": flat} | each for each in changes]
    path.write_text(json.dumps({"images": [image], "annotations": entries, "categories": []}))
    return path


def detected(tmp_path: Path, source: Path) -> list[dict[str, Any]]:
    """The rows of the fits to a detector's file."""
    names = [str(number) for number in range(8)]
    pairs = zip(names, POINTS.tolist(), strict=True)
    model = tmp_path / "model.keypoints.json"
    ModelKeypoints(tuple(ModelKeypoint(name, tuple(xyz)) for name, xyz in pairs)).save(model)
    np.savetxt(tmp_path / "K.txt", CAMERA.matrix)
    Image.new("RGB", (640, 480)).save(tmp_path / "a.png")
    arguments = ["fit", str(source), "--model", str(model), "--camera", str(tmp_path / "K.txt")]
    assert main([*arguments, "--no-picture", "--out", str(tmp_path / "run")]) in (0, 3)
    return rows_of(tmp_path / "run")


def test_objects_of_a_detector_that_cannot_be_read_fail_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = [
        {"keypoints": [float("nan"), 2.0, 1.0] * 8},
        {"keypoints": [1.0] * 32},
        {"keypoints": None},
        {"keypoints": [1.0, 2.0, -0.5] * 8},
        {"keypoints": [1.0, "12.5", 0.5] * 8},
        {"image_id": 7},
    ]
    source = coco(tmp_path / "found.json", {}, *bad, {"category_id": 5}, {"score": "high"})
    rows = detected(tmp_path, source)
    assert [row["status"] for row in rows] == ["ok"] * 3 + ["failed"] * len(bad)
    assert rows[3]["reason"].startswith(
        f"{source}: annotations[1]: keypoints: keypoint 0 has the invalid pixel "
    )
    assert "failed 1: " in capsys.readouterr().err


def test_a_bad_line_of_a_table_fails_its_object_alone(tmp_path: Path) -> None:
    lines = ["image,name,u,v,score"]
    for image in ("a.png", "b.png", "c.png"):
        for name, (u, v) in enumerate(PIXELS.tolist()):
            score = -1 if (image, name) == ("c.png", 3) else 0.5
            u = float("nan") if (image, name) == ("b.png", 2) else u
            lines.append(f"{image},{name},{u},{v},{score}")
    source = tmp_path / "found.csv"
    source.write_text("\n".join(lines))
    rows = detected(tmp_path, source)
    assert [row["status"] for row in rows] == ["ok", "failed", "failed"]
    assert [row["reason"].removeprefix(str(source)) for row in rows[1:]] == [
        ", line 12: u: 'nan' is not a finite number",
        ", c.png: scores: keypoint 3 has the value -1, which is negative",
    ]


def test_a_detectors_file_without_a_good_object_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = coco(tmp_path / "found.json", {"keypoints": [float("inf")] * 24})
    assert main(["fit", str(source), "--model", "m.keypoints.json"]) == 1
    reason = f"{source}: annotations[0]: keypoints: keypoint 0 has the invalid pixel [inf, inf]"
    assert reason in capsys.readouterr().err


def test_photo_of_another_size_than_its_camera_is_warned_of(tmp_path: Path) -> None:
    problem = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
    photo = tmp_path / "photo.png"
    write_image(photo, np.zeros((960, 1280, 3), dtype=np.uint8))
    seen = Observation(problem.points_3d, problem.points_2d, problem.camera, image=photo)
    seen.save(tmp_path / "seen.json")
    run_many(FitRunOptions(inputs=(tmp_path / "seen.json",)), tmp_path / "run")
    (row,) = rows_of(tmp_path / "run")
    assert row["warning_kinds"].split("; ")[-1] == "camera"
    assert "photo.png: the image has 1280 x 960 pixels, but its camera has 640 x" in row["warnings"]
