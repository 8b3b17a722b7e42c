"""Estimates of other programs: matched, scored and reported."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from support.pages import embedded_payload
from support.photo_sets import write_kitti

from cadalign import Alignment
from cadalign.cli import main
from cadalign.datasets import Bop, Scan2CAD
from cadalign.datasets.photos.bop_files import write_bop_results, write_scene_gt
from cadalign.datasets.photos.dataset import PoseEstimate
from cadalign.errors import DataError, InputError
from cadalign.evaluation.experiments.estimates import method_names
from cadalign.evaluation.photos.given import match_estimates
from cadalign.evaluation.photos.target import PhotoTarget
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run
from cadalign.geometry.rotations import rotation_from_vector

pytestmark = pytest.mark.usefixtures("no_figures")

CAMERA = {"fx": 500.0, "fy": 500.0, "cx": 160.0, "cy": 120.0, "width": 320, "height": 240}
TURN = rotation_from_vector(np.array([0.3, -0.4, 0.2]))


def pose(x: float, *, depth: float = 900.0) -> Alignment:
    return Alignment(TURN, [x, 0.0, depth], np.ones(3))


def estimate(image: str, model: int, alignment: Alignment, score: float = 1.0) -> PoseEstimate:
    return PoseEstimate("4", image, f"obj_{model:06d}", alignment, score)


TRUTH = [
    estimate("0", 1, pose(-120.0)),
    estimate("0", 2, pose(0.0)),
    estimate("0", 2, pose(120.0)),
    estimate("3", 1, pose(40.0)),
]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A BOP scene of two images without pixels: models 1 and 2, of which one is there twice."""
    root = tmp_path / "bop" / "test" / "000004"
    root.mkdir(parents=True)
    write_scene_gt(root / "scene_gt.json", TRUTH)
    (root / "camera.json").write_text(json.dumps(CAMERA))
    models = tmp_path / "bop" / "models"
    models.mkdir()
    for number in (1, 2):
        box = trimesh.creation.box([60.0, 40.0, 20.0 * number])
        box.export(models / f"obj_{number:06d}.ply")
    return tmp_path / "bop"


def report(tmp_path: Path, data: Path, *files: Path) -> tuple[int, Run]:
    folder = tmp_path / "run"
    names = [str(path) for path in files]
    arguments = ["report", "--estimates", *names, "--data", str(data), "--run", str(folder)]
    code = main(arguments)
    return code, spec().open(folder)


def spec() -> Spec:
    from cadalign.evaluation.registry import spec_named

    return spec_named("estimates")


@pytest.mark.long
def test_truth_is_perfect_and_errors_are_as_made(
    tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    off = [replace(TRUTH[0], cam_from_model=pose(-110.0)), *TRUTH[1:3]]  # 1 cm off, and one missing
    write_bop_results(tmp_path / "truth.csv", TRUTH)
    write_bop_results(tmp_path / "off.csv", off)
    code, run = report(tmp_path, scene, tmp_path / "truth.csv", tmp_path / "off.csv")
    assert code == 3  # some rows failed
    rows = run.results.to_pylist()
    perfect = [row for row in rows if row["method"] == "truth"]
    assert len(perfect) == 4
    assert all(row["mssd"] < 1e-9 and row["box_iou"] > 1 - 1e-9 for row in perfect)
    assert all(row["translation_cm"] < 1e-9 for row in perfect)
    other = {row["model_id"]: row for row in rows if row["method"] == "off"}
    first = other["test/000004/0/0"]
    assert first["translation_cm"] == pytest.approx(1.0)
    # All points move by 10 mm, in diameters of the box 60 x 40 x 20 mm.
    assert first["mssd"] == pytest.approx(10 / np.linalg.norm([60, 40, 20]))
    missing = other["test/000004/3/0"]
    assert (missing["status"], missing["reason"]) == ("failed", "there is no estimate")
    assert "of 8 rows failed" in capsys.readouterr().err
    payload = embedded_payload(tmp_path / "run" / "report.html")
    assert [each["key"] for each in payload["methods"]] == ["truth", "off"]
    assert len(payload["tables"]["instances"]["id"]) == 4


@pytest.mark.long
def test_scene_gt_is_read_as_results(tmp_path: Path, scene: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    write_scene_gt(folder / "scene_gt.json", TRUTH)
    code, run = report(tmp_path, scene, folder / "scene_gt.json")
    assert code == 0
    assert run.methods == ["mine/scene_gt"]


@pytest.mark.long
def test_bad_lines_and_strays_are_counted_and_the_rest_is_scored(
    tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.csv"
    write_bop_results(path, [*TRUTH, estimate("77", 1, pose(0.0))])
    text = path.read_text()
    cut = "4,0,1,1,1 0 0"
    path.write_text(f"{text}{cut}\n")
    code, run = report(tmp_path, scene, path)
    assert code == 0
    assert set(run.results["status"].to_pylist()) == {"ok"}
    said = capsys.readouterr().err
    assert "1 records of results could not be read, 1 of results are of no photo here" in said


def test_the_best_estimates_of_a_model_are_matched_with_the_nearest_objects(scene: Path) -> None:
    photo = Bop(scene)[0]
    targets = [PhotoTarget(photo, found, str(scene)) for found in photo.objects]
    poses = [
        estimate("0", 2, pose(118.0), 0.9),
        estimate("0", 2, pose(1.0), 0.8),
        estimate("0", 2, pose(0.0), 0.1),  # the third best of two
    ]
    found = match_estimates(targets, poses)
    assert {key: each.score for key, each in found.items()} == {"1": 0.8, "2": 0.9}


def test_poses_of_another_scene_are_not_taken(tmp_path: Path, scene: Path) -> None:
    path = tmp_path / "results.csv"
    write_bop_results(path, [replace(each, scene="5") for each in TRUTH])
    dataset = Bop(scene)
    file = dataset.open_poses(path)
    assert file.poses_in(dataset[0]) == ()
    assert file.strays(dataset.names) == 4


def test_names_of_methods() -> None:
    paths = [Path("a/results.csv"), Path("b/scene_gt.json"), Path("c/scene_gt.json")]
    assert method_names(paths) == ("results", "b/scene_gt", "c/scene_gt")
    assert method_names([Path("a/x.csv"), Path("b/x.csv")]) == ("a/x", "b/x")
    assert method_names([Path("a/x.csv"), Path("a/x.json")]) == ("a/x.csv", "a/x.json")
    with pytest.raises(InputError, match="is given twice"):
        method_names([Path("a.csv"), Path("a.csv")])


def test_refusals_name_the_file_or_the_option(
    tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.csv"
    write_bop_results(path, TRUTH)

    def refusal(*arguments: object) -> str:
        assert main(["report", *map(str, arguments)]) == 1
        return capsys.readouterr().err

    assert "--estimates: the photos that they are of are not known" in refusal("--estimates", path)
    run = ("--run", tmp_path / "run")
    assert "--estimates: give at least one file" in refusal("--data", scene, *run)
    gone = tmp_path / "gone.csv"
    assert f"{gone}: no such file" in refusal("--estimates", gone, "--data", scene, *run)
    path.write_text(path.read_text()[:30])
    assert "the first line is not scene_id" in refusal("--estimates", path, "--data", scene, *run)
    other = tmp_path / "annotations.json"
    other.write_text("[]")
    said = refusal("--estimates", other, "--data", scene, *run)
    assert f"not a file of poses for BOP, which {scene} holds" in said
    assert "give a CSV file of results, or one as scene_gt.json" in said
    kitti = write_kitti(tmp_path / "kitti")
    said = refusal("--estimates", other, "--data", kitti, *run)
    assert f"not a file of poses for KITTI, which {kitti} holds" in said


@pytest.fixture
def scan2cad(real_data: Path) -> Path:
    return real_data / "real" / "scan2cad"


def annotations(root: Path) -> list[dict[str, Any]]:
    data: list[dict[str, Any]] = json.loads(Scan2CAD(root).annotations.read_text())
    return data


@pytest.mark.long
def test_scan2cad_poses_are_seen_from_the_frames(tmp_path: Path, scan2cad: Path) -> None:
    mine = annotations(scan2cad)
    shown = int(Scan2CAD(scan2cad)[0].objects[0].object_id)
    moved = mine[0]["aligned_models"][shown]["trs"]
    moved["translation"] = (np.array(moved["translation"]) + [0.1, 0.0, 0.0]).tolist()
    moved["scale"] = (np.array(moved["scale"]) * [1.1, 1.1, 1.1]).tolist()
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(mine))
    _, run = report(tmp_path, scan2cad, path)
    rows = [row for row in run.results.to_pylist() if row["status"] == "ok"]
    assert len(rows) == 3
    off = max(rows, key=lambda row: row["scan2cad_scale"])
    assert off["scan2cad_scale"] == pytest.approx(0.1)
    others = [row for row in rows if row is not off]
    assert all(row["scan2cad_translation_m"] < 1e-9 for row in others)
    assert all(row["scan2cad_aligned"] == 1 for row in others)


def test_scan2cad_poses_of_another_scan_are_refused(tmp_path: Path, scan2cad: Path) -> None:
    mine = annotations(scan2cad)
    mine[0]["id_scan"] = "scene9999_00"
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(mine))
    with pytest.raises(DataError, match="no frame of the 1 annotated scans is here"):
        Scan2CAD(scan2cad).open_poses(path)


@pytest.mark.long
def test_a_run_goes_on_only_with_the_same_file(tmp_path: Path, scene: Path) -> None:
    path = tmp_path / "results.csv"
    write_bop_results(path, TRUTH)
    report(tmp_path, scene, path)
    config = RunFolder(tmp_path / "run").read_config()
    assert config is not None
    assert config["methods"] == ["results"]
    write_bop_results(path, TRUTH[:2])
    arguments = ["--estimates", str(path), "--data", str(scene), "--run", str(tmp_path / "run")]
    assert main(["report", *arguments]) == 1
