"""`cadalign evaluate retrieval`: queries, protocols, rows, summaries, runs, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cadalign import Box, Library
from cadalign.errors import DataError, InputError
from cadalign.evaluation.api import run
from cadalign.evaluation.experiments.retrieval import (
    RetrievalRunOptions,
    RetrievalTask,
    observe_model,
    retrieval_benchmark,
    retrieval_tasks,
    same_shapes,
    summarize_queries,
)
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run, read_table
from cadalign.metrics import box_iou, box_iou_up_to_scale
from cadalign.retrieval import LibraryModel

pytestmark = pytest.mark.slow

MODELS = 16
LAST = f"{MODELS - 1:03d}"
QUICK = RetrievalRunOptions(Path(), keypoints=(6, 8))


def make_model(number: int, *, keypoints: int = 12, category: str = "box") -> LibraryModel:
    """Models about 15 % of their extent apart."""
    base = np.random.default_rng(0).uniform(-0.3, 0.3, (keypoints, 3))
    xyz = base + 0.05 * np.random.default_rng(1 + number).standard_normal((keypoints, 3))
    bounds = np.array([xyz.min(axis=0), xyz.max(axis=0)])
    return LibraryModel(category, f"{number:03d}", xyz, np.arange(keypoints), bounds)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Models; the last one is the first one, stretched."""
    models = [make_model(number) for number in range(MODELS - 1)]
    models.append(replace(models[0], model_id=LAST, xyz=models[0].xyz * [1, 1.3, 0.8]))
    path = tmp_path_factory.mktemp("library") / "boxes.cadalign"
    Library.from_models(models).save(path)
    return path


@pytest.fixture(scope="module")
def finished(library: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "run")
    run(replace(QUICK, root=library), folder, workers=0, dask=None)
    return folder


def rows_of(folder: RunFolder, **wanted: Any) -> list[dict[str, Any]]:
    rows = read_table(folder.results).to_pylist()
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


class TestQueries:
    def test_keypoints_are_those_of_the_stretched_model_with_noise(self) -> None:
        model = make_model(3)
        errors = []
        for seed in range(40):
            task = RetrievalTask("box", "003", 2.0, 7)
            query = observe_model(model, task, seed=seed)
            assert len(query.points_2d) == 7
            assert len(set(query.ids.tolist())) == 7
            projected = KEYPOINT_CAMERA.project(query.gt.apply(model.xyz[query.ids]))
            errors.append(query.points_2d - projected)
            assert query.gt.scale[0] == 1
            assert ((query.gt.scale[1:] > 0.5) & (query.gt.scale[1:] < 2)).all()
        assert np.std(errors) == pytest.approx(2.0, rel=0.1)

    def test_they_depend_only_on_seed_and_task(self) -> None:
        model, task = make_model(3), RetrievalTask("box", "003", 1.0, 7)
        one = observe_model(model, task, seed=0)
        np.testing.assert_array_equal(one.points_2d, observe_model(model, task, seed=0).points_2d)
        for other, seed in ((task, 1), (replace(task, noise_px=2.0), 0)):
            assert (observe_model(model, other, seed=seed).points_2d != one.points_2d).all()

    def test_tasks_are_the_models_with_enough_keypoints(self) -> None:
        models = [make_model(1), make_model(2, keypoints=7), make_model(3, category="can")]
        library = Library.from_models(models)
        options = RetrievalRunOptions(Path(), keypoints=(9, 6))
        tasks = retrieval_tasks(library, options)
        assert [task.protocol for task in tasks[:2]] == ["leave-in", "leave-out"]
        found = [(task.model_id, task.keypoints) for task in tasks[::2]]
        assert found == [("001", 6), ("001", 9), ("002", 6), ("003", 6), ("003", 9)]
        some = replace(options, categories=("can",))
        assert {task.category for task in retrieval_tasks(library, some)} == {"can"}
        few = replace(options, max_models=1)
        assert {task.model_id for task in retrieval_tasks(library, few)} == {"001", "003"}

    def test_models_that_differ_by_a_stretch_count_as_equal(self, library: Path) -> None:
        opened = Library.open(library)
        assert same_shapes(opened, ("box", "000")) == {("box", "000"), ("box", LAST)}
        assert same_shapes(opened, ("box", "005")) == {("box", "005")}


class TestRows:
    @pytest.mark.long
    def test_there_is_one_for_each_query_and_protocol(self, finished: RunFolder) -> None:
        rows = rows_of(finished)
        assert len(rows) == MODELS * 2 * 2
        assert {row["status"] for row in rows} == {"ok"}
        keys = [(row["model_id"], row["keypoints"], row["protocol"]) for row in rows]
        assert len(set(keys)) == len(rows)
        assert keys[:2] == [("000", 6, "leave-in"), ("000", 6, "leave-out")]

    def test_the_true_model_comes_first(self, finished) -> None:
        rows = rows_of(finished, protocol="leave-in", keypoints=8)
        assert np.mean([row["rank"] == 1 for row in rows]) > 0.95
        assert np.median([row["box_iou"] for row in rows]) > 0.7

    def test_leave_out_removes_the_model_and_its_equals(self, finished) -> None:
        for row in rows_of(finished, protocol="leave-out"):
            assert row["rank"] is None
            assert row["matched_id"] != row["model_id"]
            assert {row["matched_id"], row["model_id"]} != {"000", LAST}
            assert row["shape_distance"] > 0.01

    def test_numbers_are_those_of_the_best_match(self, finished, library: Path) -> None:
        opened = Library.open(library)
        row = rows_of(finished, model_id="007", protocol="leave-out")[1]
        task = RetrievalTask("box", "007", 1.0, 8)
        model = opened["box", "007"]
        query = observe_model(model, task, seed=0)
        best = opened.retrieve(
            query.points_2d,
            query.ids,
            KEYPOINT_CAMERA,
            shape_sigma=0.02,
            exclude=[("box", "007")],
            top=50,
        )[0]
        assert row["matched_id"] == best.model_id
        assert row["score"] == pytest.approx(best.score)
        assert row["rms_px"] == pytest.approx(best.rms)
        truth = Box.from_model(model.bounds, query.gt)
        assert row["box_iou"] == pytest.approx(box_iou(est=best.box, gt=truth))
        up_to_scale = box_iou_up_to_scale(est=best.box, gt=truth)
        assert row["box_iou_up_to_scale"] == pytest.approx(up_to_scale)
        assert up_to_scale >= row["box_iou"]

    def test_models_without_a_view_are_skipped(self, tmp_path: Path) -> None:
        """Keypoints inside the hull are never all visible."""
        xyz = np.vstack(
            [make_model(1).xyz[:8], np.random.default_rng(5).uniform(-0.01, 0.01, (6, 3))]
        )
        model = replace(make_model(1, keypoints=12), xyz=xyz, ids=np.arange(14))
        other = replace(model, model_id="2", xyz=xyz * [1.1, 1, 1])
        path = tmp_path / "lib"
        Library.from_models([model, other]).save(path)
        options = replace(QUICK, keypoints=(14,))
        experiment = retrieval_benchmark(str(path), options)
        rows = experiment.evaluate([RetrievalTask("box", "001", 1.0, 14)])
        assert [row["status"] for row in rows] == ["skipped"]
        assert "14 keypoints should be visible" in rows[0]["reason"]


class TestRuns:
    def test_another_library_is_refused(self, finished: RunFolder, tmp_path: Path) -> None:
        other = tmp_path / "other"
        Library.from_models([make_model(number) for number in range(10)]).save(other)
        (own,) = (finished.path / "library").iterdir()
        with pytest.raises(DataError, match="another configuration: library is"):
            run(replace(QUICK, root=other), finished, workers=None, dask=None)
        config = finished.read_config()
        assert config is not None
        assert own.stem == config["library"]
        assert Library.open(own).fingerprint.startswith(own.stem)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"noise_px": -1.0}, "noise_px: -1.0 is not a noise level"),
            ({"keypoints": ()}, "keypoints: none is given"),
            ({"keypoints": (3, 9)}, "keypoints: 3 is less than 4"),
            ({"max_models": 0}, "max_models: 0 is less than 1"),
            ({"seed": -1}, "seed: -1 is less than 0"),
        ],
    )
    def test_invalid_options_are_refused(self, change: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError, match=message):
            replace(QUICK, **change)


class TestSummaries:
    def test_rates_and_medians_are_those_of_the_rows(self, finished: RunFolder) -> None:
        summaries = summarize_queries(Run.open(finished.path))
        assert len(summaries) == 2 * 2
        for summary in summaries:
            rows = rows_of(
                finished,
                protocol=summary["protocol"],
                keypoints=summary["keypoints"],
            )
            assert (summary["instances"], summary["failed"]) == (MODELS, 0)
            ious = [row["box_iou"] for row in rows]
            assert summary["box_iou"] == pytest.approx(np.median(ious))
            assert summary["box_iou_up_to_scale"] >= summary["box_iou"]
            ranks = [row["rank"] for row in rows]
            if summary["protocol"] == "leave-out":
                assert np.isnan([summary["rank_1"], summary["reciprocal_rank"]]).all()
                continue
            assert summary["rank_1"] == pytest.approx(np.mean([rank == 1 for rank in ranks]))
            assert summary["reciprocal_rank"] == pytest.approx(
                np.mean([0.0 if rank is None else 1 / rank for rank in ranks])
            )
