"""`cadalign evaluate unseen`: views, methods, metrics, coverage, resumed runs, refusals."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cadalign import Alignment, Box
from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation.api import run
from cadalign.evaluation.experiments.unseen import METHODS, SPEC, UnseenOptions
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import observe_object, unseen_tasks
from cadalign.evaluation.metrics.errors import probability_level
from cadalign.evaluation.runs.engine import Progress
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run, read_table
from cadalign.metrics import box_iou
from cadalign.report.headline import headline_of

SYNSET = "03001627"
BASE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
TRAIN, OBJECTS = 40, 8


def make_object(number: int) -> dict[str, Any]:
    """A frame of random proportions with two bars of random height; its diagonal is 1."""
    rng = np.random.default_rng(number)
    extents = np.exp(0.2 * rng.standard_normal(3))
    bars = [[0.0, height, 0.5] for height in 0.1 * rng.standard_normal(2) + [0.1, -0.1]]
    points = np.vstack([BASE, bars]) * extents / np.linalg.norm(extents)
    points[-1, 0] += 0.05 * rng.standard_normal()
    labels = [label for label in range(len(points)) if label != 3 or number % 4]
    place = {"face_index": 0, "face_uv": [1.0, 0.0, 0.0]}
    return {
        "class_id": SYNSET,
        "model_id": f"{number:03d}",
        "keypoints": [
            {"xyz": points[label].tolist(), "semantic_id": label, "mesh_info": place}
            for label in labels
        ],
    }


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames in KeypointNet's layout, without meshes."""
    path = tmp_path_factory.mktemp("frames")
    (path / "annotations").mkdir()
    (path / "splits").mkdir()
    objects = [make_object(number) for number in range(TRAIN + OBJECTS)]
    (path / "annotations" / "chair.json").write_text(json.dumps(objects))
    for name, numbers in (("train", range(TRAIN)), ("val", range(TRAIN, TRAIN + OBJECTS))):
        lines = [f"{SYNSET}-{number:03d}\n" for number in numbers]
        (path / "splits" / f"{name}.txt").write_text("".join(lines))
    return path


@pytest.fixture(scope="module")
def finished(root: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "run")
    run(UnseenOptions(root), folder, workers=0, dask=None)
    return folder


def column(folder: RunFolder, name: str, method: str) -> np.ndarray:
    cells = Run.open(folder.path).cells
    return np.asarray(cells[name][cells["method"] == method].astype(float))


class TestRecords:
    @pytest.mark.long
    def test_records_reproduce_the_metrics(self, finished: RunFolder) -> None:
        """Pose, box and warped keypoints of every method."""
        errors = {
            (row["model_id"], row["method"]): (row["keypoint_error"], row["box_iou"])
            for row in read_table(finished.results).to_pylist()
        }
        records = read_table(finished.records).to_pylist()
        assert len(records) == OBJECTS
        for row in records:
            record = json.loads(row["exhibit"])
            gt = pose(record["gt"])
            assert [each["method"] for each in record["estimates"]] == list(METHODS)
            for estimate in record["estimates"]:
                found = pose(estimate)
                truth, est = (np.array(estimate["warp"][end]) for end in ("from", "to"))
                est, truth = found.apply(est), gt.apply(truth)
                factor = (est * truth).sum() / (est * est).sum()
                error = np.sqrt(((factor * est - truth) ** 2).sum(axis=1).mean())
                boxes = (Box.from_model(record["bounds"], each) for each in (found, gt))
                expected = errors[row["model_id"], estimate["method"]]
                assert error == pytest.approx(expected[0], abs=1e-4)
                assert box_iou(**dict(zip(("est", "gt"), boxes, strict=True))) == pytest.approx(
                    expected[1], abs=1e-4
                )
                assert estimate["method"] not in ("shape", "exact") or estimate["rms_px"] >= 0


def pose(record: dict[str, Any]) -> Alignment:
    return Alignment(np.reshape(record["rotation"], (3, 3)), record["translation"], record["scale"])


class TestViews:
    def test_depend_on_names_alone(self, root: Path) -> None:
        options = UnseenOptions(root)
        tasks = unseen_tasks(KeypointNet(root), options)
        all_points = observe_object(tasks[1], options)
        few = observe_object(tasks[1], replace(options, keypoints=5))
        assert len(few.points_2d) == 5
        rows = [all_points.ids.tolist().index(label) for label in few.ids]
        np.testing.assert_array_equal(all_points.points_2d[rows], few.points_2d)
        np.testing.assert_array_equal(all_points.gt.rotation, few.gt.rotation)
        other = observe_object(tasks[1], replace(options, seed=1))
        assert np.abs(other.points_2d - all_points.points_2d).max() > 1

    def test_noise_scales(self, root: Path) -> None:
        options = UnseenOptions(root, noise_px=1.0)
        task = unseen_tasks(KeypointNet(root), options)[0]
        clean = observe_object(task, replace(options, noise_px=0.0))
        np.testing.assert_allclose(
            clean.points_2d, KEYPOINT_CAMERA.project(clean.gt.apply(clean.xyz))
        )
        noisy = observe_object(task, options).points_2d - clean.points_2d
        doubled = observe_object(task, replace(options, noise_px=2.0)).points_2d - clean.points_2d
        np.testing.assert_allclose(doubled, 2 * noisy)


class TestLevel:
    @pytest.mark.long
    def test_levels_of_gaussian_errors_are_uniform(self) -> None:
        rng = np.random.default_rng(0)
        root = rng.standard_normal((3, 3))
        errors = rng.standard_normal((4000, 3)) @ root.T
        levels = np.array([probability_level(error, root @ root.T) for error in errors])
        for nominal in (0.1, 0.5, 0.68, 0.95):
            assert (levels <= nominal).mean() == pytest.approx(nominal, abs=0.025)

    def test_an_error_without_variance_has_level_1(self) -> None:
        covariance = np.diag([0.0, 1.0, 1.0])
        # In two dimensions, a squared distance of 2 log 2 has the level one half.
        level = probability_level(np.array([0.0, np.sqrt(2 * np.log(2)), 0.0]), covariance)
        assert level == pytest.approx(0.5)
        assert probability_level(np.array([0.1, 0.0, 0.0]), covariance) == 1.0
        assert probability_level(np.ones(3), np.zeros((3, 3))) is None
        assert probability_level(np.ones(3), np.full((3, 3), np.nan)) is None


class TestRun:
    def test_every_method_has_a_row_of_every_object(self, finished: RunFolder) -> None:
        cells = Run.open(finished.path).cells
        assert cells["method"].tolist() == list(METHODS) * OBJECTS
        assert set(cells["status"]) == {"ok"}
        assert (cells["seconds"] > 0).all()

    def test_learned_shapes_beat_other_models(self, finished: RunFolder) -> None:
        rotation, iou = (
            {name: np.median(column(finished, key, name)) for name in METHODS}
            for key in ("rotation_error_deg", "box_iou_up_to_scale")
        )
        for name in ("mean-rigid", "mean-stretched"):
            assert rotation["shape"] < rotation[name]
            assert iou["shape"] > iou[name]
        assert iou["shape"] > 0.85
        assert rotation["exact"] == pytest.approx(rotation["limit"], rel=0.5)

    def test_only_methods_with_covariances_have_levels(self, finished: RunFolder) -> None:
        assert np.isnan(column(finished, "rotation_level", "limit")).all()
        assert np.isfinite(column(finished, "rotation_level", "mean-rigid")).all()
        assert np.isnan(column(finished, "stretch_level", "mean-rigid")).all()
        for key in ("rotation_level", "stretch_level", "keypoints_within_68"):
            levels = column(finished, key, "shape")
            assert ((levels >= 0) & (levels <= 1)).all()
        inside, further = (
            column(finished, f"keypoints_within_{percent}", "shape") for percent in (68, 95)
        )
        assert (inside <= further).all()

    @pytest.mark.long
    def test_an_interrupted_run_ends_with_the_same_bytes(
        self, root: Path, finished: RunFolder, tmp_path: Path
    ) -> None:
        class Killed(Exception):
            pass

        def kill(progress: Progress) -> None:
            if progress.done:
                raise Killed

        options = UnseenOptions(root, views_per_model=2, methods=("shape",))
        whole, broken = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "broken")
        run(options, whole, workers=0, dask=None)
        with pytest.raises(Killed):
            run(options, broken, workers=0, dask=None, on_progress=kill)
        assert broken.parts.is_dir()
        learned = {path: path.stat().st_mtime_ns for path in broken.path.glob("learned/*/*")}
        assert len(learned) == 1
        run(options, broken, workers=0, dask=None)
        assert {path: path.stat().st_mtime_ns for path in learned} == learned
        assert broken.results.read_bytes() == whole.results.read_bytes()
        assert broken.config_file.read_bytes() == whole.config_file.read_bytes()

    @pytest.mark.long
    def test_bad_objects_do_not_stop_the_others(self, root: Path, tmp_path: Path) -> None:
        spoiled = tmp_path / "frames"
        (spoiled / "annotations").mkdir(parents=True)
        (spoiled / "splits").symlink_to(root / "splits")
        objects = json.loads((root / "annotations" / "chair.json").read_text())
        objects[TRAIN]["keypoints"][0]["xyz"] = [0, 0]
        objects[TRAIN + 1]["keypoints"] = objects[TRAIN + 1]["keypoints"][:2]
        objects[TRAIN + 2]["keypoints"][0]["semantic_id"] = 77
        (spoiled / "annotations" / "chair.json").write_text(json.dumps(objects))
        folder = RunFolder(tmp_path / "run")
        run(UnseenOptions(spoiled, methods=("shape", "limit")), folder, workers=0, dask=None)
        table = read_table(folder.results).to_pandas().set_index(["model_id", "method"])
        assert "xyz" in table.reason[f"{TRAIN:03d}", "shape"]
        assert table.status[f"{TRAIN + 1:03d}", "limit"] == "failed"
        # Keypoints without a counterpart in the category are left out.
        assert table.status[f"{TRAIN + 2:03d}", "shape"] == "ok"
        assert (table.status.to_numpy()[6:] == "ok").all()


class TestOptions:
    @pytest.mark.parametrize(
        ("options", "text"),
        [
            ({"keypoints": 0}, "keypoints: 0 is less than 1"),
            ({"methods": ("shape", "magic")}, "methods: unknown method 'magic'; known are mean-"),
            ({"methods": ()}, "methods: none is given"),
            ({"split": "train"}, "split, train: both are 'train'"),
            ({"noise_px": float("nan")}, "noise_px: nan is not a noise level"),
        ],
    )
    def test_refusals(self, options: dict[str, Any], text: str) -> None:
        with pytest.raises(InputError) as caught:
            UnseenOptions(Path(), **options)
        assert str(caught.value).startswith(text)

    def test_a_category_must_have_models_to_learn_from(self, root: Path, tmp_path: Path) -> None:
        folder = RunFolder(tmp_path / "run")
        with pytest.raises(InputError, match="unknown split 'tarin'"):
            run(UnseenOptions(root, train="tarin"), folder, workers=0, dask=None)
        few = tmp_path / "frames"
        (few / "splits").mkdir(parents=True)
        (few / "annotations").symlink_to(root / "annotations")
        (few / "splits" / "val.txt").write_text((root / "splits" / "val.txt").read_text())
        (few / "splits" / "train.txt").write_text(f"{SYNSET}-000\n{SYNSET}-001\n")
        with pytest.raises(InputError, match="models of chair: 2 are too few"):
            run(UnseenOptions(few), folder, workers=0, dask=None)


@pytest.mark.usefixtures("no_figures")
class TestCommand:
    def test_table_and_plots_are_written(self, finished: RunFolder) -> None:
        summaries = SPEC.write(Run.open(finished.path))
        with finished.summary.open() as file:
            lines = list(csv.DictReader(file))
        assert [line["method"] for line in lines] == list(METHODS)
        assert float(lines[2]["rotation_in_68"]) == summaries[2]["rotation_in_68"]
        assert lines[-1]["rotation_in_68"] == ""
        names = [plot.id for plot in SPEC.plots([Run.open(finished.path)])]
        assert names == ["within_rotation_error_deg", "within_box_iou_up_to_scale"]
        headline = headline_of([Run.open(finished.path)])
        assert "limit" in {row["method"] for row in headline["rows"]}
