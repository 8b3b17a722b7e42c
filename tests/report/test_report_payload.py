"""The report's payload: contents for finished and unfinished runs, escaped texts, errors."""

from __future__ import annotations

import base64
import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from support.pages import embedded_payload

from cadalign import Alignment, Box, Camera
from cadalign.datasets import KeypointNet
from cadalign.errors import DataError, InputError
from cadalign.evaluation.api import run as do_run
from cadalign.evaluation.experiments.keypointnet import (
    KeypointNetOptions,
    KeypointTasks,
    keypointnet_benchmark,
)
from cadalign.evaluation.experiments.simulation import SweepOptions
from cadalign.evaluation.instances.record import record_stem
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_table
from cadalign.metrics import box_iou, rotation_error
from cadalign.report import write_report
from cadalign.report.instances import compact

METHODS = ("optimal", "aepnp", "aepnp-paper", "limit")
HOSTILE = "<img src=x onerror=alert(1)>&amp;\u2028</script><!--"


def evaluate(root: Path, out: Path, **options: Any) -> Path:
    do_run(KeypointNetOptions(root, **options), RunFolder(out), workers=0, dask=None)
    return out


def report(tmp_path: Path, *runs: Path, **options: Any) -> dict[str, Any]:
    return embedded_payload(write_report(runs, tmp_path / "report.html", **options))


def annotations(folder: Path, names: list[str], *, points: int = 12) -> Path:
    """A data set of annotations without meshes."""
    rng = np.random.default_rng(0)
    entries = [
        {
            "class_id": "03624134",
            "model_id": name,
            "keypoints": [
                {
                    "xyz": xyz,
                    "semantic_id": row,
                    "mesh_info": {"face_index": 0, "face_uv": [1.0, 0.0, 0.0]},
                }
                for row, xyz in enumerate(rng.uniform(-0.3, 0.3, (points, 3)).tolist())
            ],
        }
        for name in names
    ]
    (folder / "annotations").mkdir(parents=True)
    (folder / "annotations" / "knife.json").write_text(json.dumps(entries))
    return folder


@pytest.fixture(scope="module")
def drawn(sample_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over 4 models, 2 views of each, with pictures."""
    out = tmp_path_factory.mktemp("drawn") / "run"
    return evaluate(sample_root, out, methods=METHODS, views_per_model=2, render="overlay")


@pytest.fixture(scope="module")
def payload(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return report(tmp_path_factory.mktemp("page"), drawn)


def columns(payload: dict[str, Any]) -> tuple[list[str], dict[str, Any], dict[str, Any]]:
    tables = payload["tables"]
    return tables["strings"], tables["instances"], tables["rows"]


def alignment(pose: dict[str, Any]) -> Alignment:
    return Alignment(np.reshape(pose["rotation"], (3, 3)), pose["translation"], pose["scale"])


# --- tables ----------------------------------------------------------------------------------


@pytest.mark.long
def test_columns_hold_every_instance_and_row(drawn: Path, payload: dict[str, Any]) -> None:
    strings, instances, rows = columns(payload)
    results = read_table(drawn / "results.parquet").to_pylist()
    assert {len(column) for column in instances.values()} == {8}
    assert {len(column) for column in rows.values()} == {len(results)} == {8 * len(METHODS)}
    for row, result in enumerate(results):
        instance = rows["instance"][row]
        assert strings[instances["category"][instance]] == result["category"]
        assert strings[instances["model"][instance]] == result["model_id"]
        assert instances["view"][instance] == result["view"]
        assert instances["keypoints"][instance] == result["keypoints"]
        assert payload["methods"][rows["method"][row]]["key"] == result["method"]
        assert rows["status"][row] == 0
        assert rows["reason"][row] == -1
        for metric in payload["metrics"]:
            assert rows[metric["key"]][row] == pytest.approx(result[metric["key"]], rel=1e-5)
    assert instances["id"] == list(range(8))


@pytest.mark.slow
def test_metrics_without_a_value_are_not_offered(drawn: Path, tmp_path: Path) -> None:
    run = shutil.copytree(drawn, tmp_path / "run")
    table, kept = pq.read_table(run / "results.parquet"), {"rotation_error_deg", "rms_px"}
    names = {metric["key"] for metric in report(tmp_path, run)["metrics"]}
    assert kept < names
    for without in (names - kept, names):
        for place, name in enumerate(table.column_names):
            if name in without:
                nothing = pa.nulls(len(table), table.schema.field(name).type)
                table = table.set_column(place, name, nothing)
        pq.write_table(table, run / "results.parquet")
        offered = {metric["key"] for metric in report(tmp_path, run)["metrics"]}
        assert offered == (names - without or names)


def test_headline_marks_the_best_method_but_never_the_limit(payload: dict[str, Any]) -> None:
    headline = payload["headline"]
    assert [column["key"] for column in headline["columns"]][:2] == ["instances", "failed"]
    better = {column["key"]: column["better"] for column in headline["columns"]}
    for category in ("bottle", "car", "chair", "vessel", "all"):
        rows = [row for row in headline["rows"] if row["category"] == category]
        assert [row["method"] for row in rows] == list(METHODS)
        rivals = [row for row in rows if row["method"] != "limit"]
        assert rows[-1]["best"] == []
        for key, direction in better.items():
            marked = [row["method"] for row in rivals if key in row["best"]]
            if direction is None:
                assert not marked
                continue
            values = [row["cells"][key] for row in rivals]
            best = min(values) if direction == "low" else max(values)
            assert marked == [row["method"] for row in rivals if row["cells"][key] == best]


def test_summary_names_methods_and_data(payload: dict[str, Any], sample_root: Path) -> None:
    assert payload["summary"].startswith(
        "3 methods and the Cramer-Rao bound on views of models of sample (8), "
        "with cadalign 0.1.0 on 20"
    )
    assert payload["title"] == "Alignment on sample"
    (run,) = payload["runs"]
    assert (run["what"], run["state"], run["done"], run["total"]) == (
        "keypointnet",
        "finished",
        8,
        8,
    )
    assert ["noise", "1 px"] in run["settings"]
    assert ["dataset", str(sample_root)] in run["settings"]
    assert ["methods", ", ".join(METHODS)] in run["settings"]


def test_numbers_that_are_not_finite_become_null() -> None:
    assert compact([np.nan, np.inf, -np.inf, 0.123456789, None]) == [None] * 3 + [0.123457, None]


# --- exhibits --------------------------------------------------------------------------------


def test_exhibits_reproduce_the_errors(payload: dict[str, Any]) -> None:
    _, instances, rows = columns(payload)
    assert instances["exhibit"] == list(range(8))
    for place in range(8):
        exhibit = payload["exhibits"][str(place)]
        truth = alignment(exhibit["gt"])
        np.testing.assert_allclose(truth.scale * exhibit["stretch"], 1)
        camera = Camera(**exhibit["camera"])
        projected = camera.project(truth.apply(exhibit["points_3d"]))
        assert np.abs(projected - exhibit["points_2d"]).max() < 6  # the noise is 1 px
        assert len(exhibit["semantic_ids"]) == len(projected) == instances["keypoints"][place]
        assert [estimate["method"] for estimate in exhibit["estimates"]] == list(METHODS)
        for k, estimate in enumerate(exhibit["estimates"]):
            found = alignment(estimate)
            row = place * len(METHODS) + k
            assert rotation_error(est=found, gt=truth) == pytest.approx(
                rows["rotation_error_deg"][row], rel=1e-4
            )
            boxes = (Box.from_model(exhibit["bounds"], each) for each in (found, truth))
            iou = box_iou(**dict(zip(("est", "gt"), boxes, strict=True)))
            assert iou == pytest.approx(rows["box_iou"][row], rel=1e-4)
            assert (estimate["std"] is None) == (estimate["method"] != "optimal")


def test_warnings_and_alternatives_are_kept(tmp_path: Path) -> None:
    root = annotations(tmp_path / "data", [f"four_{k}" for k in range(8)], points=4)
    run = evaluate(root, tmp_path / "run", methods=("optimal",), min_visible=4)
    exhibits = report(tmp_path, run)["exhibits"].values()
    optimal = [exhibit["estimates"][0] for exhibit in exhibits]
    assert any(estimate.get("warnings") for estimate in optimal)
    alternatives = [other for e in optimal for other in e.get("alternatives", [])]
    assert alternatives
    for other in alternatives:
        assert 0 < other["likelihood"] <= 1
        assert alignment(other).scale[0] == 1


def test_pictures_show_the_model_without_boxes_and_thumbs_with_them(
    payload: dict[str, Any],
) -> None:
    _, instances, _ = columns(payload)
    for place in range(8):
        exhibit = payload["exhibits"][str(place)]
        plain = pixels(payload["pictures"][exhibit["picture"]])
        small = pixels(payload["thumbs"][str(instances["thumb"][place])])
        assert plain.shape == (480, 640, 3)
        assert small.shape == (240, 320, 3)
        box = Box.from_model(exhibit["bounds"], alignment(exhibit["gt"]))
        camera = Camera(**exhibit["camera"])
        corners = camera.project(box.corners)
        # Colours change along the box's edges, projected by the scaled camera.
        nearest = plain[::2, ::2].astype(int)
        changed = np.abs(small.astype(int) - nearest).max(axis=2) > 60
        rows, cols = np.nonzero(changed)
        assert len(rows) > 200
        low, high = corners.min(axis=0) / 2, corners.max(axis=0) / 2
        assert abs(cols.min() - low[0]) < 12
        assert abs(rows.max() - high[1]) < 12


def pixels(url: str) -> Any:
    kind, _, data = url.partition(",")
    assert kind == "data:image/webp;base64"
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        return np.asarray(image.convert("RGB"))


def test_missing_pictures_are_omitted(drawn: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(drawn, tmp_path / "copy"))
    for name in ("pictures", "thumbs", "previews"):
        shutil.rmtree(copy / name)
    found = report(tmp_path, copy)
    assert found["pictures"] == found["thumbs"] == found["meshes"] == {}
    assert set(found["tables"]["instances"]["thumb"]) == {-1}
    assert all(e["picture"] is None and e["mesh"] is None for e in found["exhibits"].values())
    assert len(found["exhibits"]) == 8
    (copy / "records.parquet").unlink()
    found = report(tmp_path, copy)
    assert set(found["tables"]["instances"]["exhibit"]) == {-1}
    assert len(found["headline"]["rows"]) == 5 * len(METHODS)


def test_pictures_of_different_instances_have_different_names() -> None:
    ids = ["a", "a_1", "a_2", "a_1_1", "a_10", "a_0", "a_01", "a/1", "x" * 300 + "_1"]
    keys = [("chair", name, view) for name in ids for view in range(12)]
    stems = {record_stem(*key) for key in keys}
    assert len(stems) == len(keys)
    assert all(len(stem) < 250 and "/" not in stem for stem in stems)
    usual = "1a2b3c4d5e6f708192a3b4c5d6e7f809"
    assert record_stem("chair", usual, 3) == f"chair_{usual}_3"
    assert record_stem("chair", "sample_chair_002") == "chair_sample_chair_002"


# --- size ------------------------------------------------------------------------------------


def test_page_is_as_small_as_promised(drawn: Path, tmp_path: Path) -> None:
    written = write_report([drawn], tmp_path / "report.html")
    assert written.stat().st_size < 3e6 + 8 * 60e3
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_a_page_is_full_at_its_limit_and_says_so(
    drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cadalign.report.instances.MEDIA_LIMIT", 10_000)
    found = report(tmp_path, drawn)
    kept = len(found["exhibits"])
    assert 0 < kept < 8
    assert [place >= 0 for place in found["tables"]["instances"]["exhibit"]] == [
        index < kept for index in range(8)
    ]
    assert found["summary"].endswith(
        f"The last {8 - kept} instances are shown without pictures and poses."
    )


# --- odd runs --------------------------------------------------------------------------------


def test_texts_cannot_end_the_payload(tmp_path: Path) -> None:
    names = [HOSTILE, "a/b", "..", "x" * 300, "nul\0l", "\"'`", "μ-模型"]
    run = evaluate(annotations(tmp_path / "data", names), tmp_path / "run", methods=("optimal",))
    page = write_report([run], tmp_path / "page.html")
    text = page.read_text(encoding="utf-8")
    assert "onerror" in text
    assert "<img" not in text.split("</noscript>")[0]
    inside = text.split('id="payload">')[1].split("</script>")[0]
    assert not set("<>&\u2028") & set(inside)
    found = embedded_payload(page)
    strings, instances, _ = columns(found)
    assert {strings[place] for place in instances["model"]} == set(names)


def test_a_run_whose_views_show_too_few_keypoints_says_so_and_counts_no_failure(
    tmp_path: Path,
) -> None:
    root = annotations(tmp_path / "data", ["a", "b"])
    run = evaluate(root, tmp_path / "run", methods=("optimal", "aepnp"), min_visible=13)
    found = report(tmp_path, run)
    _, instances, rows = columns(found)
    assert rows["status"] == instances["id"] == []
    assert found["exhibits"] == found["pictures"] == {}
    for row in found["headline"]["rows"]:
        counts = [row["cells"][name] for name in ("instances", "failed", "skipped")]
        assert counts == [0, 0, 2]
        assert row["cells"].keys() == {"instances", "failed", "skipped"}
    assert found["headline"]["failures"] == []
    skipped = found["headline"]["skipped"]
    assert [(f["method"], f["count"]) for f in skipped] == [("optimal", 2), ("aepnp", 2)]
    assert all("13 keypoints should be visible" in each["reason"] for each in skipped)


@pytest.mark.long
def test_an_unfinished_run_shows_what_there_is(tmp_path: Path) -> None:
    root = annotations(tmp_path / "data", [f"m{k:03d}" for k in range(150)])
    run = evaluate(root, tmp_path / "run", methods=("optimal", "limit"))
    whole = report(tmp_path, run)
    unfinished = half_finished(run, KeypointNetOptions(root, methods=("optimal", "limit")))
    found = report(tmp_path, unfinished)
    (state,) = found["runs"]
    assert (state["state"], state["done"], state["total"]) == ("unfinished", 64 + 22, 150)
    assert "unfinished: 86 of 150 tasks are done" in found["summary"]
    strings, instances, _ = columns(found)
    names = [strings[place] for place in instances["model"]]
    assert names == [f"m{k:03d}" for k in (*range(64), *range(128, 150))]
    assert len(found["exhibits"]) == 86
    last = whole["exhibits"]["149"]
    assert found["exhibits"]["85"] == last


def half_finished(run: Path, options: KeypointNetOptions) -> Path:
    """Remove the second of three chunks from a run."""
    from cadalign.evaluation.runs.tables import write_rows

    folder = RunFolder(run)
    for path in (folder.results, folder.records, folder.timings):
        path.unlink()
    folder.parts.mkdir()
    experiment = keypointnet_benchmark(options, drawn_in=None)
    tasks = KeypointTasks(KeypointNet(options.root), options)
    for index in (0, 2):
        rows = experiment.evaluate(tasks[64 * index : 64 * index + 64])
        columns = (*experiment.columns, ("seconds", float), experiment.record_columns[-1])
        write_rows(folder.part(index), columns, rows)
    return run


def test_several_runs_are_joined_by_instances(tmp_path: Path) -> None:
    root = annotations(tmp_path / "data", ["a", "b", "c"])
    first = evaluate(root, tmp_path / "x" / "run", methods=("optimal", "aepnp"))
    second = evaluate(
        root, tmp_path / "y" / "run", methods=("optimal", "epnp"), noise_px=3.0, max_models=2
    )
    found = report(tmp_path, first, second)
    assert [run["name"] for run in found["runs"]] == ["x/run", "y/run"]
    assert found["title"] == "2 runs compared: alignment on data"
    assert [method["key"] for method in found["methods"]] == ["optimal", "aepnp", "epnp"]
    strings, instances, _ = columns(found)
    assert instances["run"] == [0, 0, 0, 1, 1]
    assert instances["id"] == [0, 1, 2, 0, 1]
    assert [strings[k] for k in instances["model"]] == ["a", "b", "c", "a", "b"]
    for one, other in ((0, 3), (1, 4)):  # the same view and stretch, other noise
        assert instances["keypoints"][one] == instances["keypoints"][other]
        exhibits = found["exhibits"]
        assert exhibits[str(one)]["gt"] == exhibits[str(other)]["gt"]
        assert exhibits[str(one)]["points_2d"] != exhibits[str(other)]["points_2d"]
    assert {row["run"] for row in found["headline"]["rows"]} == {0, 1}
    assert found["summary"].count("x/run: ") == found["summary"].count("y/run: ") == 1


def test_compared_runs_share_pictures(drawn: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(drawn, tmp_path / "copy"))
    found = report(tmp_path, drawn, copy)
    assert len(found["pictures"]) == len(found["thumbs"]) == 8
    assert len(found["meshes"]) == 4
    assert len(found["exhibits"]) == 16


# --- other kinds of runs ---------------------------------------------------------------------


def test_a_simulation_has_lines_and_no_gallery(tmp_path: Path) -> None:
    options = SweepOptions("noise", values=(1, 4), runs=12, methods=("optimal", "aepnp", "limit"))
    do_run(options, RunFolder(tmp_path / "run"), workers=0, dask=None)
    found = report(tmp_path, tmp_path / "run")
    assert found["tables"] is None
    assert found["title"] == "Simulation of noise"
    assert found["headline"]["group"] == "keypoint noise [px]"
    assert [row["category"] for row in found["headline"]["rows"]] == ["1"] * 3 + ["4"] * 3
    plot = found["plots"][0]
    assert (plot["id"], plot["x"]["unit"], plot["y"]["log"]) == ("rotation_error_deg", "px", True)
    for trace in plot["traces"]:
        assert trace["x"] == [1, 4]
    medians = {
        (row["category"], row["method"]): row["cells"]["rotation_error_deg"]
        for row in found["headline"]["rows"]
    }
    for trace in plot["traces"]:
        for value, median in zip(("1", "4"), trace["y"], strict=True):
            assert medians[value, trace["method"]] == pytest.approx(median, rel=1e-5)
    assert "problems of the AEPnP paper's simulation" in found["summary"]


# --- refusals --------------------------------------------------------------------------------


BEGUN = '{"experiment": "keypointnet", "tasks": 3, "chunk_size": 1}'


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (None, "no such folder; give a folder that cadalign demo, evaluate or simulate"),
        ({}, "not the folder of a run: it has no run.json; give a folder"),
        ({"run.json": '{"experiment": "brewing"}'}, "no report on a run of 'brewing'; known are k"),
        ({"run.json": "{"}, "not valid JSON"),
        ({"run.json": BEGUN}, "nothing of the run is finished yet; wait, or start the same"),
        ({"run.json": BEGUN, "results.parquet": "no table"}, "the table cannot be read"),
    ],
)
def test_other_folders_are_refused(
    tmp_path: Path, files: dict[str, str] | None, message: str
) -> None:
    if files is not None:
        (tmp_path / "run").mkdir()
    for name, text in (files or {}).items():
        (tmp_path / "run" / name).write_text(text)
    with pytest.raises(DataError, match=message) as error:
        write_report([tmp_path / "run"], tmp_path / "report.html")
    assert str(tmp_path / "run") in str(error.value)
    assert not (tmp_path / "report.html").exists()


def test_incomparable_runs_are_refused(drawn: Path, tmp_path: Path) -> None:
    for name in ("noise", "points"):
        options = SweepOptions(name, values=(8,), runs=1, methods=("aepnp",))
        do_run(options, RunFolder(tmp_path / name), workers=0, dask=None)
    page = tmp_path / "report.html"
    with pytest.raises(InputError, match="none is given"):
        write_report([], page)
    with pytest.raises(InputError, match="the run is given twice"):
        write_report([drawn, drawn / ".." / drawn.name], page)
    with pytest.raises(InputError, match=r"noise is a run of simulation of noise, .* views"):
        write_report([drawn, tmp_path / "noise"], page)
    with pytest.raises(InputError, match=r"of points, .* of noise; write a report"):
        write_report([tmp_path / "noise", tmp_path / "points"], page)


def test_a_page_that_cannot_be_written_is_an_error(drawn: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="cannot be written"):
        write_report([drawn], tmp_path / "file" / "report.html")
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match="is a folder; give a file's name"):
        write_report([drawn], tmp_path / "folder")
