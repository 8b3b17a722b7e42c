"""`cadalign evaluate photos`: every layout's truth, metrics, bad records, resumed runs, pages."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.files import replaced, write_json
from support.pages import embedded_payload
from support.photo_sets import (
    WRITERS,
    pose,
    write_pix3d,
    write_scan2cad,
)
from support.refusals import refusal_line, refusal_text

import cadalign.datasets
from cadalign import Alignment, Camera
from cadalign.cli import main
from cadalign.datasets.photo import PhotoDataset
from cadalign.errors import DegenerateError
from cadalign.evaluation.api import run
from cadalign.evaluation.benchmark import Benchmark
from cadalign.evaluation.experiments.photos import COLUMNS, SPEC, PhotosOptions, summarize_objects
from cadalign.evaluation.instances.photos import PhotoEstimate, PhotoObjects
from cadalign.evaluation.instances.pictures import crop_photo
from cadalign.evaluation.instances.sighting import Sighting, annotations_of, photo_tasks, photos_of
from cadalign.evaluation.methods import Method
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run
from cadalign.evaluation.summary import Summary
from cadalign.geometry.alignment import Box

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("no_figures")]

PERFECT = {
    "rotation_error_deg": 0.0, "box_iou": 1.0, "box_iou_up_to_scale": 1.0,
    "scan2cad_translation_m": 0.0, "scan2cad_scale": 0.0, "scan2cad_aligned": 1.0,
    "scan2cad_aligned_axes": 1.0,
}  # fmt: skip
OWN = {
    "Pix3D": {"rotation_error_deg", "box_iou"},
    "Scan2CAD": {"rotation_error_deg", "box_iou", "scan2cad_aligned", "scan2cad_aligned_axes"},
    "PASCAL3D+": {"rotation_error_deg"},
}
"""Metrics by data set."""


@pytest.fixture(autouse=True)
def _fresh() -> None:
    """Data sets are listed once in a process; tests change them."""
    photos_of.cache_clear()


def done(root: Path, out: Path, **options: Any) -> Run:
    """A finished run."""
    photos_of.cache_clear()
    run(PhotosOptions(root, **options), RunFolder(out), workers=0, dask=None)
    return SPEC.open(out)


def rows_of(found: Run, method: str) -> list[dict[str, Any]]:
    return [row for row in found.results.to_pylist() if row["method"] == method]


class TestTruth:
    @pytest.mark.parametrize("kind", WRITERS)
    def test_has_perfect_scores_in_every_layout(self, tmp_path: Path, kind: str) -> None:
        WRITERS[kind](tmp_path / "data")
        found = done(tmp_path / "data", tmp_path / "run", methods=("truth",))
        rows = rows_of(found, "truth")
        assert rows
        for row in rows:
            assert row["status"] == "ok", row["reason"]
            known = {name for name in PERFECT if row[name] is not None}
            assert OWN[kind] <= known
            for name in known:
                assert row[name] == pytest.approx(PERFECT[name], abs=1e-4), name
        assert found.config["kind"] == kind

    @pytest.mark.parametrize("kind", WRITERS)
    def test_is_found_from_the_keypoints_alone(self, tmp_path: Path, kind: str) -> None:
        """With exact models, the keypoints of methods fit the truth."""
        WRITERS[kind](tmp_path / "data")
        method = "stretched" if kind == "Scan2CAD" else "rigid"
        found = done(tmp_path / "data", tmp_path / "run", methods=(method,))
        for row in rows_of(found, method):
            assert row["status"] == "ok", row["reason"]
            assert row["rotation_error_deg"] < 1.0
            assert row["rms_px"] < 0.6


def score_poses(dataset: PhotoDataset, poses: dict[tuple[str, str], Alignment]) -> list[Any]:
    """Rows of a method with given poses by photo and object, which fails on other objects."""

    def given(sighting: Sighting) -> PhotoEstimate:
        target = sighting.target
        pose = poses.get((target.photo.name, target.found.object_id))
        if pose is None:
            raise DegenerateError("there is no estimate")
        return PhotoEstimate(pose, Box.from_model(sighting.bounds, pose))

    setting = PhotoObjects(PhotosOptions(dataset.root, pictures=0), RunFolder(Path("unused")))
    return Benchmark(setting, (Method("given", given),)).evaluate(photo_tasks(dataset, None))


def summarize_rows(rows: list[Any]) -> list[Summary]:
    names = (*(name for name, _ in COLUMNS), "seconds")
    cells = {name: np.array([row.get(name) for row in rows], dtype=object) for name in names}
    run: Any = SimpleNamespace(cells=cells, methods=["given"], metrics=())
    return summarize_objects(run)


class TestSyntheticErrors:
    def test_have_the_scores_of_their_definitions(self, tmp_path: Path) -> None:
        """A box moved by 30 mm in depth, and a box rotated by 90 degrees about an axis."""
        dataset = cadalign.datasets.open(write_scan2cad(tmp_path / "data"))
        truth = {
            (photo.name, found.object_id): found.truth.cam_from_model
            for photo in dataset
            for found in photo.objects
        }
        first, second = truth
        moved = Alignment(
            truth[first].rotation, truth[first].translation + [0, 0, 0.03], truth[first].scale
        )
        turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        turned = replace(truth[second], rotation=truth[second].rotation @ turn)
        a, b = score_poses(dataset, {first: moved, second: turned})
        assert a["scan2cad_translation_m"] == pytest.approx(0.03)
        assert b["rotation_error_deg"] == pytest.approx(90.0)
        (line,) = summarize_rows([a, b])
        assert line.values["accuracy_pi_6"] == 0.5

    def test_a_category_where_everything_failed_counts(self, tmp_path: Path) -> None:
        dataset = cadalign.datasets.open(write_pix3d(tmp_path / "data", photos=2))
        found = dataset[0].objects[0].truth.cam_from_model
        solved, failed = score_poses(dataset, {("0", "0"): found})
        own = solved["category"]
        lines = summarize_rows([solved, *({**failed, "category": name} for name in (own, "other"))])
        shares = {line.group: line.values["accuracy_pi_6"] for line in lines}
        assert shares == {own: 0.5, "other": 0, "all": 1 / 3}
        assert "scan2cad_aligned" not in lines[0].values  # of another data set's protocol


class TestMethods:
    def test_a_mask_helps(self, tmp_path: Path) -> None:
        root = write_pix3d(tmp_path / "data", noise=2.0)
        found = done(root, tmp_path / "run", methods=("rigid", "rigid+mask"))
        error = {
            name: np.median([row["rotation_error_deg"] for row in rows_of(found, name)])
            for name in found.methods
        }
        assert error["rigid+mask"] < error["rigid"]
        assert all(row["status"] == "ok" for row in found.results.to_pylist())

    def test_objects_without_the_evidence_are_left_out(self, tmp_path: Path) -> None:
        root = write_pix3d(tmp_path / "data", photos=2)
        (root / "mask" / "1.png").unlink()
        methods = ("rigid", "rigid+mask", "rigid+gravity")
        found = done(root, tmp_path / "run", methods=methods)
        rows = found.results.to_pylist()
        assert [row["status"] for row in rows] == [
            *("ok", "ok", "left out"),
            *("ok", "left out", "left out"),
        ]
        assert [row["reason"] for row in rows[3:]] == [
            "",
            "the object has no mask",
            "the direction of gravity is unknown",
        ]

    def test_few_keypoints_are_left_out(self, tmp_path: Path) -> None:
        root = write_pix3d(tmp_path / "data", photos=3)
        entries = json.loads((root / "pix3d.json").read_text())
        marks = entries[1]["2d_keypoints"][0]
        entries[1]["2d_keypoints"] = [[*marks[:5], *[[-1.0, -1.0]] * (len(marks) - 5)]]
        write_json(root / "pix3d.json", entries)
        found = done(root, tmp_path / "run", methods=("rigid",))
        assert [row["status"] for row in found.results.to_pylist()] == ["ok", "left out", "ok"]
        assert rows_of(found, "rigid")[1]["reason"] == "5 keypoints are fewer than 6"


class TestBadRecords:
    def test_are_counted_and_do_not_stop_the_rest(self, tmp_path: Path) -> None:
        root = write_pix3d(tmp_path / "data", photos=5)
        entries = json.loads((root / "pix3d.json").read_text())
        entries[0]["focal_length"] = -1
        entries[1]["model"] = "model/renamed.obj"
        entries[2]["3d_keypoints"] = "model/renamed.txt"
        del entries[3]["img_size"]
        write_json(root / "pix3d.json", [*entries, 7])
        found = done(root, tmp_path / "run", methods=("rigid", "rigid+mask"))
        rows = rows_of(found, "rigid")
        assert [row["category"] for row in rows] == [
            "unreadable", "table", "chair", "unreadable", "chair", "unreadable",
        ]  # fmt: skip
        assert [row["status"] for row in rows] == [
            "failed", "ok", "left out", "failed", "ok", "failed",
        ]  # fmt: skip
        assert "focal_length" in rows[0]["reason"]
        assert rows_of(found, "rigid+mask")[1]["status"] == "left out"  # without the mesh
        groups = [line.group for line in SPEC.summarize(found) if line.method == "rigid"]
        assert groups == ["chair", "table", "unreadable", "all"]

    def test_objects_and_scans_are_counted(self, tmp_path: Path) -> None:
        root = write_scan2cad(tmp_path / "data", frames=3)
        (scan,) = json.loads((root / "full_annotations.json").read_text())
        scan["aligned_models"].append(7)
        write_json(root / "full_annotations.json", [scan, 7])
        (root / "scans/scene0000_00/pose/1.txt").write_text("x")
        found = done(root, tmp_path / "run", methods=("rigid",))
        rows = rows_of(found, "rigid")
        assert [row["status"] for row in rows] == [
            *("failed", "ok"), "failed", *("failed", "ok"), "failed",
        ]  # fmt: skip
        assert rows[0]["model_id"] == "scene0000_00/0, problem 1"
        assert "pose/1.txt" in rows[2]["reason"]
        assert "full_annotations.json" in rows[5]["reason"]


class TestRuns:
    def test_changed_annotations_are_refused(self, tmp_path: Path) -> None:
        root = write_pix3d(tmp_path / "data")
        done(root, tmp_path / "run", methods=("rigid",))
        entries = json.loads((root / "pix3d.json").read_text())
        turn = Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix()
        for entry in entries:
            entry["rot_mat"] = (entry["rot_mat"] @ turn).tolist()
        write_json(root / "pix3d.json", entries)
        options = PhotosOptions(root, methods=("rigid",))
        text = refusal_text(lambda: run(options, RunFolder(tmp_path / "run"), workers=0, dask=None))
        assert "holds a run with another configuration: annotations is" in text
        run(options, RunFolder(tmp_path / "again"), workers=0, dask=None)
        errors = SPEC.open(tmp_path / "again").results["rotation_error_deg"].to_numpy()
        assert (errors > 20).all()  # of the changed file, which is read anew

    @pytest.mark.parametrize("kind", WRITERS)
    def test_every_file_of_annotations_counts(self, tmp_path: Path, kind: str) -> None:
        WRITERS[kind](tmp_path / "data")
        dataset = photos_of(tmp_path / "data")
        seen = {annotations_of(dataset, photo_tasks(dataset, None))}
        ends = (".json", ".txt", ".mat")
        files = [path for path in dataset.root.rglob("*") if path.suffix in ends]
        for path in files:
            path.write_bytes(path.read_bytes() + b"\n")
            seen.add(annotations_of(dataset, photo_tasks(dataset, None)))
        assert len(seen) == len(files) + 1


class TestPage:
    def test_shows_photos_with_truth_and_estimates(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        root = write_pix3d(tmp_path / "data", photos=3)
        entries = json.loads((root / "pix3d.json").read_text())
        write_json(root / "pix3d.json", [*entries[:2], replaced(entries[2], "rot_mat", None)])
        out = tmp_path / "run"
        command = ["evaluate", "photos", root, "--out", out, "--workers", "0"]
        assert main([*map(str, command), "--methods", "rigid", "truth", "--pictures", "2"]) == 0
        assert "left out" in capsys.readouterr().err
        payload = embedded_payload(out / "report.html")
        tables = payload["tables"]
        assert len(tables["instances"]["id"]) == 3
        assert len(tables["rows"]["method"]) == 5  # without the unknown truth
        assert sum(thumb >= 0 for thumb in tables["instances"]["thumb"]) == 2
        records = [payload["exhibits"][str(key)] for key in tables["instances"]["exhibit"]]
        assert [record["gt"] is None for record in records] == [False, False, True]
        assert records[0]["camera"]["width"] == 320
        assert records[0]["mesh"] is not None
        gt = pose(0)
        np.testing.assert_allclose(records[0]["gt"]["translation"], gt.translation, atol=1e-6)
        files = {path.name for path in (out / "thumbs").iterdir()}
        assert len(files) == 2
        assert (out / "summary.csv").read_text().startswith("category,method,instances")

    def test_curves_and_tables_leave_the_same_objects_out(self, tmp_path: Path) -> None:
        root = write_pix3d(tmp_path / "data", photos=4)
        entries = json.loads((root / "pix3d.json").read_text())
        for entry in entries[:3]:
            entry["model"] = "model/renamed.obj"
        del entries[2]["img_size"]
        write_json(root / "pix3d.json", entries)
        found = done(root, tmp_path / "run", methods=("rigid+mask",))
        status = found.results["status"].to_pylist()
        assert status == ["left out", "left out", "failed", "ok"]
        (*_, every) = (line for line in SPEC.summarize(found) if line.group == "all")
        assert every.values["accuracy_pi_6"] == 0.5
        curves = {plot.id: plot.traces[0] for plot in SPEC.plots([found])}
        assert curves["within_rotation_error_deg"].y[-1] == 50
        assert curves["within_box_iou"].y[0] == 50
        shown = SPEC.shown_columns(SPEC.summarize(found), [found])
        keys = {column.key for column in shown}
        assert "accuracy_pi_6" in keys
        assert "scan2cad_aligned" not in keys

    def test_categories_may_have_the_names_of_summaries(self, tmp_path: Path) -> None:
        root = write_pix3d(tmp_path / "data", photos=3)
        entries = json.loads((root / "pix3d.json").read_text())
        for entry, name in zip(entries, ("all", "chair", "table"), strict=True):
            entry["category"] = name
        write_json(root / "pix3d.json", entries)
        found = done(root, tmp_path / "run", methods=("rigid",))
        counts = {line.group: line.values["instances"] for line in SPEC.summarize(found)}
        assert counts == {"category all": 1, "chair": 1, "table": 1, "all": 3}


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--methods", "best"), "--methods: unknown method 'best'"),
        (("--methods", "rigid+mask+mask"), "--methods: unknown method 'rigid+mask+mask'"),
        (("--methods", "truth+mask"), "--methods: truth uses keypoints only"),
        (("--methods", "shape"), "--methods: unknown method 'shape'"),
    ],
)
def test_refusals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], text: str
) -> None:
    root = write_pix3d(tmp_path / "data", photos=1)
    out = ("--out", tmp_path / "run")
    assert refusal_line(capsys, "evaluate", "photos", root, *options, *out).startswith(text)


def test_a_folder_without_photos_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = refusal_line(capsys, "evaluate", "photos", tmp_path, "--out", tmp_path / "run")
    assert "no data set of photos is recognised in this folder" in text


def test_a_thumb_shows_an_object_with_a_margin_and_has_its_camera() -> None:
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    photo = np.zeros((480, 640, 3), np.uint8)
    photo[200:261, 300:401] = 255
    corners = np.array([[300.0, 200.0], [400.0, 260.0]])
    thumb, near = crop_photo(photo, camera, corners)
    assert (near.width, near.height) == thumb.shape[1::-1]
    rows, columns = np.nonzero(thumb[..., 0] > 128)
    assert (columns.max() - columns.min()) / near.width == pytest.approx(1 / 1.4, abs=0.02)
    seen = (corners - (camera.cx, camera.cy)) * near.fx / camera.fx + (near.cx, near.cy)
    found = [(columns.min(), rows.min()), (columns.max(), rows.max())]
    np.testing.assert_allclose(found, seen, atol=3)
