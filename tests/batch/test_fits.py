"""Runs of fits: results, the table, resuming, workers, and bad input."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import cadalign
from cadalign import Alignment, CadalignError, Camera, Observation, Result, Results
from cadalign.batch import (
    DetectorOptions,
    FitRunOptions,
    ObservationChanges,
    ObservationFit,
    run_many,
)
from cadalign.batch.outputs import COLUMNS
from cadalign.batch.runs import plan_run
from cadalign.cli import main
from cadalign.errors import DataError, InputError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.geometry.rotations import rotation_from_quat_wxyz

CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
POINTS = np.random.default_rng(1).uniform(-1, 1, (8, 3))
LINEAR = ObservationFit(method="aepnp")


def observations(count: int) -> Iterator[Observation]:
    rng = np.random.default_rng(0)
    for _ in range(count):
        scale = np.array([1, *np.exp(rng.uniform(-0.3, 0.3, 2))])
        rotation = rotation_from_quat_wxyz(rng.normal(size=4))
        pose = Alignment(rotation, [0.1, 0.2, 6.0], scale)
        seen = CAMERA.project(pose.apply(POINTS)) + rng.normal(0, 1.0, (8, 2))
        yield Observation(POINTS, seen, CAMERA, ids=np.arange(8))


def lines(path: Path, count: int) -> Path:
    texts = [json.dumps(each.to_dict()) for each in observations(count)]
    path.write_text("\n".join(texts) + "\n")
    return path


def fitted(source: Path, out: Path, *, workers: Any = None, **options: Any) -> Results:
    run_many(FitRunOptions(inputs=(source,), **options), out, workers=workers)
    return Results.open(out)


def test_lines_become_results_in_their_order(tmp_path: Path) -> None:
    source = lines(tmp_path / "o.jsonl", 5)
    found = fitted(source, tmp_path / "run", estimate=ObservationFit(loss="cauchy"))
    assert len(found) == 5
    for number, each in enumerate(observations(5)):
        expected = cadalign.fit(each.points_3d, each.points_2d, CAMERA, loss="cauchy")
        single = found[number]
        assert isinstance(single, Result)
        np.testing.assert_array_equal(single.alignment.vector, expected.alignment.vector)
        np.testing.assert_allclose(found.rotation[number], expected.alignment.rotation)
        np.testing.assert_allclose(found.scale[number], expected.alignment.scale)
        assert single.covariance is not None
        assert expected.covariance is not None
        np.testing.assert_allclose(single.covariance, expected.covariance)
        np.testing.assert_allclose(found.rms[number], expected.rms)
        assert single.warnings == expected.warnings
    frame = found.to_dataframe()
    assert (frame["status"] == "ok").all()
    table = pq.read_table(tmp_path / "run" / "results.parquet")
    assert frame.columns.tolist() == [name for name in table.column_names if name in frame]
    assert frame["keypoints"].tolist() == [8] * 5


def test_the_table_has_the_documented_columns(tmp_path: Path) -> None:
    fitted(lines(tmp_path / "o.jsonl", 3), tmp_path / "run")
    table = pq.read_table(tmp_path / "run" / "results.parquet")
    assert table.column_names == [name for name, _ in COLUMNS]
    row = table.to_pylist()[1]
    found = Results.open(tmp_path / "run")[1]
    assert isinstance(found, Result)
    assert found.std is not None
    quaternion = np.array([row[f"q{axis}"] for axis in "wxyz"])
    np.testing.assert_allclose(
        rotation_from_quat_wxyz(quaternion), found.alignment.rotation, atol=1e-12
    )
    assert row["ty_std"] == found.std.translation[1]
    assert row["scale_z_std"] == found.std.scale[2]
    assert row["source"].endswith("o.jsonl, line 2")
    head = (tmp_path / "run" / "results.csv").read_text().splitlines()[0]
    assert head.replace('"', "").split(",") == table.column_names


@pytest.mark.slow
def test_workers_and_processes_leave_the_bytes_as_they_are(tmp_path: Path) -> None:
    source = lines(tmp_path / "o.jsonl", 150)
    for name, workers in (("none", 0), ("one", 1)):
        fitted(source, tmp_path / name, workers=workers, estimate=LINEAR)
    for table in ("results.parquet", "records.parquet", "results.csv"):
        assert (tmp_path / "none" / table).read_bytes() == (tmp_path / "one" / table).read_bytes()


def test_workers_may_have_been_started_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (seen,) = observations(1)
    Path("given").mkdir()
    seen.save("given/one.json")
    Path("given/._one.json").write_bytes(b"Mac OS X")  # of an archive
    options = FitRunOptions(
        inputs=(Path("given"),), estimate=ObservationFit(shape=Path("chair.shape"))
    )
    monkeypatch.setattr(FitRunOptions, "keypoints", lambda self: None)
    plan = plan_run(options, RunFolder(Path("run")))
    (task,) = plan.tasks[:]
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    (row,) = plan.experiment.evaluate([task])
    assert row["reason"].startswith(f"{tmp_path / 'chair.shape'}: ")
    assert row["source"] == "given/one.json"


def test_bad_observations_are_rows_and_stop_nothing(tmp_path: Path) -> None:
    good = next(observations(1)).to_dict()
    without_camera = {name: value for name, value in good.items() if name != "camera"}
    bad: list[Any] = [
        good,
        without_camera,
        {**good, "keypoints": good["keypoints"][:2]},
        {**good, "keypoints": []},
        {**good, "kamera": 1},
        [1, 2],
        {**good, "object": "car"},
        {**good, "object": "car"},
        {**good, "fit": {"method": "epnp", "sigma": -1}},
    ]
    source = tmp_path / "o.jsonl"
    source.write_text("\n".join([*map(json.dumps, bad), "{", ""]), encoding="utf-8")
    results = fitted(source, tmp_path / "run")
    assert [isinstance(each, CadalignError) for each in results] == [
        *(False, True, True, True, True, True, False, False, True, True)
    ]
    assert "line 2: camera: missing" in str(results[1])
    assert "line 10: not valid JSON: " in str(results[9])
    table = pq.read_table(tmp_path / "run" / "results.parquet").to_pylist()
    assert [row["object"] for row in table[6:8]] == ["car", "car"]
    assert table[1]["status"] == "failed"
    assert table[1]["qw"] is None


def test_another_input_or_option_is_refused(tmp_path: Path) -> None:
    source = lines(tmp_path / "o.jsonl", 3)
    fitted(source, tmp_path / "run", estimate=LINEAR)
    with pytest.raises(DataError, match=r"another configuration: estimate\.method is"):
        fitted(source, tmp_path / "run")
    lines(source, 4)
    with pytest.raises(DataError, match="another configuration: contents is"):
        fitted(source, tmp_path / "run", estimate=LINEAR)


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"estimate": ObservationFit(method="magic")}, "method"),
        ({"estimate": ObservationFit(sigma=-1.0)}, "sigma"),
        ({"estimate": ObservationFit(focal="guess")}, "focal"),  # type: ignore[arg-type]
        ({"estimate": ObservationFit(shape=Path("none.shape"))}, "none.shape"),
        ({"pictures": -1}, "pictures"),
        ({"workers": "a"}, "workers"),
    ],
)
def test_wrong_options_are_refused_before_the_run(
    tmp_path: Path, options: dict[str, Any], where: str
) -> None:
    source = lines(tmp_path / "o.jsonl", 1)
    with pytest.raises(CadalignError) as caught:
        fitted(source, tmp_path / "run", **options)
    assert caught.value.where == where
    assert not (tmp_path / "run").exists()


def test_a_focal_length_may_be_that_of_all_cameras(tmp_path: Path) -> None:
    source = lines(tmp_path / "o.jsonl", 2)
    found = fitted(source, tmp_path / "run", changes=ObservationChanges(focal=650))
    assert found.focal_length.tolist() == [650.0, 650.0]


def test_files_of_others_are_not_written_over(tmp_path: Path) -> None:
    source = lines(tmp_path / "o.jsonl", 2)
    for name in ("results.csv", "report.html"):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_text("mine")
        with pytest.raises(DataError, match=f"holds {name} but no run.json: not the folder"):
            fitted(source, folder)
        assert (folder / name).read_text() == "mine"


def test_a_byte_order_mark_is_no_part_of_the_first_observation(tmp_path: Path) -> None:
    source = lines(tmp_path / "o.jsonl", 3)
    plain = fitted(source, tmp_path / "plain")
    source.write_bytes(b"\xef\xbb\xbf" + source.read_bytes())
    np.testing.assert_array_equal(fitted(source, tmp_path / "marked").rotation, plain.rotation)


def test_the_contents_are_those_of_every_file_that_options_name(tmp_path: Path) -> None:
    source = lines(tmp_path / "o.jsonl", 1)
    camera, model = tmp_path / "K.txt", tmp_path / "model.keypoints.json"
    np.savetxt(camera, CAMERA.matrix)
    options: dict[str, Any] = {"camera": camera, "model": model}
    seen = {plan_run(FitRunOptions(inputs=(source,)), RunFolder(tmp_path)).config["contents"]}
    for path in (model, camera):
        for text in ("700 0 320 0 700 240 0 0 1", "700 0 321 0 700 240 0 0 1"):
            path.write_text(text)
            chosen = FitRunOptions(
                inputs=(source,),
                changes=ObservationChanges(camera=options["camera"]),
                detector=DetectorOptions(model=options["model"]),
            )
            seen.add(plan_run(chosen, RunFolder(tmp_path)).config["contents"])
    assert len(seen) == 5


def test_failures_are_counted_by_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = lines(tmp_path / "o.jsonl", 3)
    with source.open("a") as file:
        file.write("{}\n{}\n[]\n")
    assert main(["fit", str(source), "--no-picture", "--out", str(tmp_path / "run")]) == 3
    first, second, last = capsys.readouterr().err.splitlines()
    assert first.startswith("failed 2: ")
    assert "line" not in first
    assert second.startswith("failed 1: ")
    assert last.startswith("3 of 6 aligned, 3 failed: ")


def test_the_how_to_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = Path(__file__).parents[2] / "docs" / "how_to" / "many_photos.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block, names)
    assert len(names["results"]) == 3


def test_the_how_to_names_every_column() -> None:
    page = Path(__file__).parents[2] / "docs" / "how_to" / "many_photos.md"
    told = page.read_text(encoding="utf-8")
    endings = ("y_std", "z_std")  # named by their first
    missing = [name for name, _ in COLUMNS if f"`{name}`" not in told]
    assert [name for name in missing if not name.endswith(endings)] == []


class TestFitMany:
    """`fit_many` takes observations of a program."""

    def test_results_come_in_order_and_nothing_is_kept(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        results = cadalign.fit_many(observations(3), method="aepnp")
        assert results.solved.all()
        assert len(set(results.translation[:, 2].tolist())) == 3
        assert list(tmp_path.iterdir()) == []

    def test_a_kept_run_is_read_again_and_refuses_other_observations(self, tmp_path: Path) -> None:
        run = tmp_path / "run"
        first = cadalign.fit_many(observations(2), out=run)
        again = cadalign.fit_many(observations(2), out=run)
        np.testing.assert_array_equal(again.rotation, first.rotation)
        with pytest.raises(DataError, match=r"run\.jsonl: holds the observations of another run"):
            cadalign.fit_many(observations(3), out=run)

    @pytest.mark.parametrize(
        ("given", "options", "message"),
        [
            ([], {}, "observations: none are given"),
            (5, {}, "observations: expected a path or a sequence, got int"),
            ("a.json", {"robots": 1}, "options: not an option: 'robots'; known are sigma"),
        ],
    )
    def test_bad_input_is_refused(self, given: Any, options: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError, match=message):
            cadalign.fit_many(given, **options)
