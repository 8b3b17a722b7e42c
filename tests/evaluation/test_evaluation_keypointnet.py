"""The KeypointNet experiment: rows, failures, summaries, overlays, the command line."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import cadalign
from cadalign.cli import main
from cadalign.datasets import KeypointNet
from cadalign.errors import DataError, InputError
from cadalign.evaluation.experiments.keypointnet import (
    COLUMNS,
    TABLE,
    KeypointNetOptions,
    KeypointTasks,
    keypointnet_benchmark,
    summarize_views,
)
from cadalign.evaluation.instances.instance import load_scene, make_instance
from cadalign.evaluation.instances.pictures import draw_instance
from cadalign.evaluation.instances.record import record_stem
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import FAILED, OK, SKIPPED
from cadalign.evaluation.summary import Summary, summary_csv
from cadalign.geometry.alignment import Alignment

METRICS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")


def entry(model_id: str, points: Any) -> dict[str, Any]:
    keypoints = [
        {
            "xyz": point,
            "semantic_id": row,
            "mesh_info": {"face_index": 0, "face_uv": [1.0, 0.0, 0.0]},
        }
        for row, point in enumerate(np.asarray(points).tolist())
    ]
    return {"class_id": "03624134", "model_id": model_id, "keypoints": keypoints}


@pytest.fixture
def annotated(tmp_path: Path) -> Path:
    """Knives without meshes: a good one, a flat one, one with few keypoints, a malformed one."""
    rng = np.random.default_rng(0)
    good = rng.uniform(-0.3, 0.3, (12, 3))
    entries = [entry("good", good), entry("flat", good * [1, 1, 0]), entry("few", good[:5])]
    entries.append({**entry("malformed", good), "keypoints": "none"})
    folder = tmp_path / "data" / "annotations"
    folder.mkdir(parents=True)
    (folder / "knife.json").write_text(json.dumps(entries))
    return folder.parent


def evaluate(root: Path, **options: Any) -> Any:
    return cadalign.evaluate(root, workers=0, **options)


@pytest.mark.slow
def test_every_model_view_and_method_has_a_row(sample_root: Path) -> None:
    table = evaluate(sample_root, views_per_model=2, methods=["optimal", "epnp", "limit"])
    assert len(table) == 4 * 2 * 3
    assert not table.duplicated(["category", "model_id", "view", "method"]).any()
    assert (table.status == OK).all()
    assert (table.visibility == "rays").all()
    optimal = table[table.method == "optimal"]
    assert (optimal.rotation_error_deg < 10).all()
    assert optimal.box_iou.between(0.3, 1).all()
    assert (optimal.keypoints >= 6).all()


def test_models_that_cannot_be_used_become_failed_or_skipped_rows(annotated: Path) -> None:
    table = evaluate(annotated, methods=["optimal", "aepnp", "limit"])
    assert len(table) == 4 * 3
    good = table[table.model_id == "good"]
    assert (good.status == OK).all()
    assert (good.visibility == "hull").all()
    failed = table[table.model_id != "good"]
    expected = np.where(failed.model_id == "few", SKIPPED, FAILED)
    assert (failed.status == expected).all()
    assert (failed.reason != "").all()
    reasons = failed.groupby("model_id").reason.first()
    assert "there are only 5" in reasons["few"]
    assert "keypoints" in reasons["malformed"]
    assert reasons["flat"]
    for metric in METRICS:
        assert failed[metric].isna().all()


@pytest.mark.long
def test_an_instance_does_not_depend_on_its_neighbours(sample_root: Path) -> None:
    methods = ("optimal", "aepnp-paper", "limit")
    options = KeypointNetOptions(sample_root, views_per_model=2, methods=methods)
    tasks = KeypointTasks(KeypointNet(sample_root), options)
    experiment = keypointnet_benchmark(options, drawn_in=None)
    together = experiment.evaluate(tasks[:])
    alone = [row for task in reversed(tasks[:]) for row in experiment.evaluate([task])]
    for row in (*together, *alone):
        del row["seconds"]
    assert sorted(map(str, together)) == sorted(map(str, alone))


def test_a_run_does_not_go_on_with_other_annotations(annotated: Path, tmp_path: Path) -> None:
    evaluate(annotated, out=tmp_path / "run", methods=["aepnp"])
    file = annotated / "annotations" / "knife.json"
    entries = json.loads(file.read_text())
    entries[0]["keypoints"][0]["xyz"][0] += 0.01
    file.write_text(json.dumps(entries))
    with pytest.raises(DataError, match="annotations is"):
        evaluate(annotated, out=tmp_path / "run", methods=["aepnp"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"categories": ["chiar"]}, "did you mean 'chair'"),
        ({"split": "trian"}, "unknown split"),
        ({"noise_px": float("nan")}, "not a noise level"),
        ({"noise_px": -1.0}, "not a noise level"),
        ({"min_visible": 0}, "min_visible"),
        ({"views_per_model": 0}, "views_per_model"),
        ({"visibility": "guess"}, "known are auto, hull"),
    ],
)
def test_bad_options_are_named(sample_root: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        evaluate(sample_root, **options)


@pytest.mark.long
def test_pictures_are_drawn_and_no_half_files_left(sample_root: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--render", "overlay", "--workers", "0", "--methods", "optimal"]
    arguments = ["evaluate", "keypointnet", str(sample_root), "--out", str(out), *options]
    assert main([*arguments, "--categories", "chair", "car"]) == 0
    models = KeypointNet(sample_root).subset(categories=["chair", "car"])
    wanted = {record_stem(*key) for key in models.ids()}
    endings = {"thumbs": ".webp", "pictures": ".webp", "previews": ".json"}
    for folder, ending in endings.items():
        files = {path.name for path in (out / folder).iterdir()}
        assert files == {f"{name}{ending}" for name in wanted}
    assert {path.suffix for path in (out / "figures").iterdir()} == {".png", ".pdf"}


@pytest.mark.slow
def test_an_estimate_behind_the_camera_is_drawn(sample_root: Path, tmp_path: Path) -> None:
    """With much noise, the Cramer-Rao bound has such estimates."""
    model = next(iter(KeypointNet(sample_root)))
    scene = load_scene(model)
    instance = make_instance(model, noise_px=1.0, min_visible=6, seed=0, view_index=0, scene=scene)
    behind = Alignment(instance.gt.rotation, -instance.gt.translation, instance.gt.scale)
    folder = RunFolder(tmp_path / "run").made_for_pictures()
    draw_instance(folder, instance, behind, "chair", "behind")
    assert (folder.thumbs / "chair_behind.webp").is_file()


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
def test_the_command_prints_json_and_says_by_its_exit_code_that_rows_failed(
    annotated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(tmp_path / "run")
    options = ["--out", run, "--workers", "0", "--methods", "optimal", "limit", "--json"]
    assert main(["evaluate", "keypointnet", str(annotated), *options]) == 3
    printed = json.loads(capsys.readouterr().out)
    assert [printed[name] for name in ("rows", "failed", "skipped")] == [6, 4, 2]
    assert {row["method"] for row in printed["summary"]} == {"optimal", "limit"}
    assert main(["evaluate", "keypointnet", str(annotated), *options]) == 3
    assert json.loads(capsys.readouterr().out)["summary"] == printed["summary"]


def row(method: str, error: float | None) -> dict[str, Any]:
    names = {"category": "chair", "model_id": "m", "view": 0, "method": method}
    if error is None:
        return {**names, "status": FAILED, "reason": "why"}
    numbers = dict.fromkeys(("rotation_error_deg", "sym_rotation_error_deg"), error)
    small = {"sym_translation_error": 0.04, "scale_y_error": 0.01, "scale_z_error": 0.01}
    other = {"translation_error": 0.06, "keypoints": 7}
    return {**names, "status": OK, "reason": "", **numbers, **small, **other}


def summaries_of(rows: list[dict[str, Any]]) -> list[Summary]:
    names = [name for name, _ in COLUMNS]
    cells = {name: np.array([row.get(name) for row in rows]) for name in names}
    methods = list(dict.fromkeys(cells["method"]))
    run: Any = SimpleNamespace(cells=cells, methods=methods, metrics=())
    return summarize_views(run)


def test_failed_rows_count_against_success_and_not_in_medians() -> None:
    rows = [row("optimal", error) for error in (1.0, 4.0, 9.0, 30.0, None)]
    rows += [row("limit", 2.0)]
    optimal, limit = summaries_of(rows)
    assert (optimal["instances"], optimal["failed"]) == (5, 1)
    assert optimal["rotation_error_deg"] == 6.5
    assert optimal["success_5deg_5pct"] == pytest.approx(2 / 5)
    assert optimal["over_limit"] == pytest.approx(3.25)
    assert limit["over_limit"] == 1.0
    assert np.isnan(optimal["box_iou"])


def test_a_category_where_all_failed_has_empty_cells() -> None:
    summaries = summaries_of([row("optimal", None)])
    assert [column.text(summaries[0][column.key]) for column in TABLE] == ["-"] * 6
    assert summary_csv(summaries, rename={}).splitlines()[1].startswith("chair,optimal,1,1,,,")


def test_overlays_of_models_without_meshes_are_refused_before_the_run(
    annotated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    options = ["--render", "overlay", "--workers", "0", "--out", str(out)]
    assert main(["evaluate", "keypointnet", str(annotated), *options]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "--render: no mesh of the " in said
    assert not (out / "results.parquet").exists()
