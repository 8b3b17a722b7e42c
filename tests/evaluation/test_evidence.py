"""`cadalign evaluate evidence`: scenes, methods, bounds, resumed runs, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.refusals import refusal_text

from cadalign.cli import main
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.estimation.align import align
from cadalign.evaluation.api import evaluate
from cadalign.evaluation.experiments.evidence import METHODS, SPEC, EvidenceRunOptions
from cadalign.evaluation.instances.evidence import (
    BOUNDS,
    ObjectScene,
    bound_of,
    evidence_benchmark,
    evidence_for,
    make_scene,
    truth_in,
)
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.runs.tables import Run

QUICK = ("keypoints", "gravity", "length", "depth", "views-2", "views-2-free", "gravity+length")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(write_sample_dataset(tmp_path_factory.mktemp("sample"), per_category=1))


@pytest.fixture(scope="module")
def car(root: Path) -> ObjectScene:
    (model,) = KeypointNet(root).subset(categories=["car"])
    return make_scene(model, 0, EvidenceRunOptions(root, noise_px=0.0))


@pytest.mark.long
def test_scene_is_the_same_each_time(root: Path) -> None:
    (model,) = KeypointNet(root).subset(categories=["car"])
    options = EvidenceRunOptions(root)
    first, again = (make_scene(model, 1, options) for _ in range(2))
    assert first.gt == again.gt
    assert first.height == again.height
    for shot, other in zip(first.shots, again.shots, strict=True):
        np.testing.assert_array_equal(shot.points_2d, other.points_2d)
        np.testing.assert_array_equal(shot.depths, other.depths)
    assert make_scene(model, 2, options).gt != first.gt


def test_shots_without_noise_show_the_truth(car: ObjectScene) -> None:
    points = np.asarray(car.model.points_3d)
    for shot in car.shots:
        seen = truth_in(shot, car.gt).apply(points[shot.rows])
        np.testing.assert_allclose(KEYPOINT_CAMERA.project(seen), shot.points_2d, atol=1e-8)
    assert car.mask().any()
    rows, columns = np.nonzero(car.mask())
    low, high = car.shots[0].points_2d.min(axis=0), car.shots[0].points_2d.max(axis=0)
    assert (low >= [columns.min() - 3, rows.min() - 3]).all()
    assert (high <= [columns.max() + 3, rows.max() + 3]).all()


@pytest.mark.parametrize("method", QUICK)
def test_bound_is_that_of_the_estimate(car: ObjectScene, method: str) -> None:
    """Without noise the estimate is the truth, where its stated covariance is the bound."""
    given = evidence_for(method, car)
    result = align(car.model, given.views, size=given.size)
    bound = bound_of(result, given, car)
    stated = result.covariance
    assert np.linalg.eigvalsh(bound)[-1] > 0
    np.testing.assert_allclose(
        np.sqrt(bound.diagonal()), np.sqrt(stated.diagonal()), rtol=0.2, atol=1e-9
    )


@pytest.mark.long
def test_every_method_gives_what_it_is_named_after(car: ObjectScene) -> None:
    for method in METHODS:
        given = evidence_for(method, car)
        first = given.views[0]
        assert (first.up is not None) == ("gravity" in method or method == "all")
        assert (given.size is not None) == ("length" in method or method == "all")
        assert (first.depth is not None) == ("depth" in method or method == "all")
        assert (first.mask is not None) == ("mask" in method or method == "all")
        count = 5 if "views-5" in method else 2 if "views-2" in method or method == "all" else 1
        assert len(given.views) == count
        known = count > 1 and not method.endswith("free")
        assert all((view.cam_from_rig is not None) == known for view in given.views)


@pytest.mark.long
def test_a_photo_and_a_mask_alone_are_methods(root: Path) -> None:
    methods = ["keypoints", "image", "mask-alone"]
    given = {"methods": methods, "categories": ["car", "chair"], "workers": 0}
    table = evaluate(root, "evidence", **given)
    assert (table.status == "ok").all()
    errors = table.groupby("method").rotation_error_deg.median()
    assert errors["image"] < 0.7 * errors["keypoints"]
    assert errors["mask-alone"] < 0.1 * errors["keypoints"]
    assert (table.keypoints[table.method == "mask-alone"] == 0).all()


@pytest.mark.long
def test_run_resumes_and_reports(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--methods", *QUICK, "--categories", "car", "chair", "--workers", "0"]
    arguments = ["evaluate", "evidence", str(root), "--out", str(out), *options]
    assert main(arguments) == 0
    before = (out / "results.parquet").read_bytes()
    assert main(arguments) == 0
    assert (out / "results.parquet").read_bytes() == before
    assert "Evidence beyond keypoints" in (out / "report.html").read_text()
    assert sorted(path.suffix for path in (out / "figures").iterdir())
    summaries = SPEC.summarize(Run.open(out))
    of_all = {each.method: each for each in summaries if each.group == "all"}
    assert set(of_all) == set(QUICK)
    assert of_all["keypoints"]["instances"] == 2
    for each in of_all.values():
        assert each["failed"] == 0
        assert 0 < each["over_limit"] < 5
    assert of_all["views-2"]["translation_error"] < of_all["keypoints"]["translation_error"]


def test_rows_have_errors_and_bounds(root: Path) -> None:
    table = evaluate(
        root, "evidence", categories=["car"], methods=["keypoints", "depth"], workers=0
    )
    assert table.status.tolist() == ["ok", "ok"]
    assert (table[list(BOUNDS)] > 0).all().all()
    np.testing.assert_allclose(
        table.over_limit, table.rotation_error_deg / table.rotation_bound_deg
    )
    keypoints, depth = (table[table.method == name].iloc[0] for name in ("keypoints", "depth"))
    assert depth.translation_bound < keypoints.translation_bound


def test_model_that_fails_gives_failed_rows(root: Path) -> None:
    options = EvidenceRunOptions(root, methods=("keypoints", "depth"))
    experiment = evidence_benchmark(options)
    (model,) = KeypointNet(root).subset(categories=["car"])
    from cadalign.evaluation.instances.instance import KeypointTask

    task = KeypointTask.of_model(
        KeypointNet(root), model.category, model.model_id, visibility="rays"
    )
    rows = experiment.failure(task, "no luck").rows
    assert [(row["method"], row["status"], row["reason"]) for row in rows] == [
        ("keypoints", "failed", "no luck"),
        ("depth", "failed", "no luck"),
    ]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"methods": ("masks",)},
            "methods: unknown method 'masks', did you mean 'mask'?; known are ",
        ),
        ({"methods": ()}, "methods: none is given; "),
        ({"min_visible": 3}, "min_visible: 3 is less than 4"),
        ({"depth_sigma": 0.0}, "depth_sigma: 0.0 is not between 0 and 90"),
        ({"turn_deg": 100.0}, "turn_deg: 100.0 is not between 0 and 90"),
    ],
)
def test_invalid_options_are_refused(root: Path, options: dict, text: str) -> None:
    assert refusal_text(lambda: EvidenceRunOptions(root, **options)).startswith(text)
