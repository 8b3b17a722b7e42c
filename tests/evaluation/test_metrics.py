"""Metrics of one's own: a function is a column of tables, summaries and pages."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.pages import embedded_payload
from support.refusals import refusal_line

import cadalign
from cadalign.cli import main
from cadalign.errors import DataError, InputError
from cadalign.evaluation import metrics as room
from cadalign.evaluation import register_metric
from cadalign.evaluation.metrics import registry
from cadalign.evaluation.metrics.photos import score_columns
from cadalign.evaluation.metrics.table import BOX_IOU, ROTATION, Metric
from cadalign.evaluation.photos.protocols import SETS
from cadalign.evaluation.plots import cumulative
from cadalign.report import headline_text


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_REGISTERED", {})


def depth_error(*, est: Any, gt: Any) -> float:
    return abs(est.translation[2] - gt.translation[2])


def spread(*, result: Any, points_3d: Any, sigma: float) -> float | None:
    assert sigma > 0
    return None if result is None else float(result.std.rotation_deg) * len(points_3d)


def broken(*, est: Any) -> float:
    raise RuntimeError("divided")


def simulate(**options: Any) -> Any:
    options = {"values": [20], "runs": 3, "methods": ["aepnp"], "workers": 0, **options}
    return cadalign.simulate("points", **options)


def test_a_registered_metric_is_a_column() -> None:
    register_metric("depth_error", depth_error, unit="units")
    table = simulate(metrics=["depth_error"])
    assert (table.depth_error > 0).all()
    assert (table.depth_error <= table.translation_error).all()
    assert "depth_error" not in simulate().columns


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
def test_it_is_shown_wherever_metrics_are(
    sample_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    register_metric("depth_error", depth_error, label="depth off", unit="mm", factor=1000)
    register_metric("spread", spread)
    out = tmp_path / "run"
    options: dict[str, Any] = {
        "methods": ["optimal", "aepnp"],
        "metrics": ["depth_error", "spread"],
    }
    table = cadalign.evaluate(sample_root, out=out, workers=1, **options)
    registry._REGISTERED.clear()  # whoever looks at the run need not know the function
    assert table[table.method == "aepnp"].spread.isna().all()
    assert (table[table.method == "optimal"].spread > 0).all()
    assert main(["evaluate", "show", str(out)]) == 0
    assert "depth off" in capsys.readouterr().out
    with (out / "summary.csv").open() as file:
        (row,) = (
            row
            for row in csv.DictReader(file)
            if (row["category"], row["method"]) == ("car", "aepnp")
        )
    chosen = table[(table.category == "car") & (table.method == "aepnp")]
    assert float(row["depth_error"]) == pytest.approx(chosen.depth_error.median())
    assert "depth off [mm]" in headline_text([out], format="csv")
    assert main(["report", str(out)]) == 0
    page = embedded_payload(out / "report.html")
    assert [metric["key"] for metric in page["metrics"]][-2:] == ["depth_error", "spread"]
    assert "depth off" in [column["label"] for column in page["headline"]["columns"]]


@pytest.mark.long
def test_every_experiment_with_functions_takes_it(real_data: Path) -> None:
    register_metric("depth_off", depth_error)
    common: dict[str, Any] = {"metrics": ["depth_off"], "workers": 0}
    for root, experiment, options in (
        (real_data / "real/scan2cad", "photos", {"methods": ["rigid"]}),
        (
            real_data / "keypointnet",
            "unseen",
            {"methods": ["shape"], "categories": ["mug"], "max_models": 2},
        ),
        (
            real_data / "sfm/maupertuis_colmap",
            "correspondences",
            {"methods": ["aepnp"], "draws": 1, "max_images": 1, "outliers": [0.0]},
        ),
    ):
        table = cadalign.evaluate(root, experiment, **common, **options)
        assert table[table.status == "ok"].depth_off.notna().all()


def test_what_a_broken_metric_raises_is_the_reason_of_its_rows() -> None:
    register_metric("broken", broken)
    table = simulate(metrics=["broken"])
    assert set(table.reason) == {"metric broken: RuntimeError: divided"}
    register_metric("text", lambda *, est: "far")
    assert set(simulate(metrics=["text"]).reason) == {"metric text: it returned str, no number"}
    for value, text in ((float("inf"), "inf"), (10**400, "1000")):
        register_metric("endless", lambda *, est, value=value: value)
        (reason,) = set(simulate(metrics=["endless"]).reason)
        assert reason.startswith(f"metric endless: it returned {text}")
        assert reason.endswith(", which is not finite")
    for value in (None, float("nan")):
        register_metric("nothing", lambda *, est, value=value: value)
        assert simulate(metrics=["nothing"]).nothing.isna().all()


def test_a_run_does_not_go_on_without_its_metrics(tmp_path: Path) -> None:
    register_metric("depth_error", depth_error)
    simulate(metrics=["depth_error"], out=tmp_path / "run")
    simulate(metrics=["depth_error"], out=tmp_path / "run")
    with pytest.raises(DataError, match="another configuration: metric"):
        simulate(out=tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        ("depth error", depth_error, "name: 'depth error' is not an identifier"),
        ("mine", 3, "function: 3 is not a function"),
        (
            "mine",
            lambda alignment: 0.0,
            "function: unknown parameter 'alignment'; known are est, gt, result, points_3d, "
            "points_2d, camera, sigma, bounds",
        ),
    ],
)
def test_what_cannot_be_registered_is_refused(name: str, function: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        register_metric(name, function)
    assert str(caught.value) == message


def test_names_that_are_unknown_or_taken_are_refused() -> None:
    with pytest.raises(InputError, match="unknown metric 'depth'; known are none before"):
        simulate(metrics=["depth"])
    register_metric("rotation_error_deg", depth_error)
    with pytest.raises(InputError, match="the table has a column 'rotation_error_deg'"):
        simulate(metrics=["rotation_error_deg"])


@pytest.mark.parametrize("name", ["failed", "instances", "success_5deg_5pct", "over_limit"])
def test_names_of_the_summary_are_refused(sample_root: Path, name: str) -> None:
    register_metric(name, depth_error)
    with pytest.raises(InputError, match=f"the table has a column '{name}'; register the"):
        cadalign.evaluate(sample_root, metrics=[name], workers=0)


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["0", "2"])
@pytest.mark.usefixtures("no_figures")
def test_what_a_plugin_prints_is_not_the_output(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    workers: str,
) -> None:
    (tmp_path / "chatty.py").write_text(
        "from cadalign.evaluation import register_metric\n"
        "print('at import')\n"
        "def depth(*, est):\n"
        "    print('hello')\n"
        "    return est.translation[2]\n"
        "register_metric('depth', depth)\n"
    )
    monkeypatch.chdir(tmp_path)
    command = ["simulate", "points", "--values", "8", "--runs", "2", "--workers", workers]
    command += ["--methods", "aepnp", "--metrics", "depth", "--plugin", "chatty.py", "--json"]
    assert main(command) == 0
    printed = capfd.readouterr()
    assert json.loads(printed.out)["failed"] == 0
    assert "at import" in printed.err
    assert "hello" in printed.err


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_a_plugin_registers_metrics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_metrics.py").write_text(
        "from cadalign.evaluation import register_metric\n"
        "register_metric('depth', lambda *, est, gt: abs(est.translation[2]), unit='units')\n"
    )
    monkeypatch.chdir(tmp_path)
    command = ["simulate", "points", "--values", "8", "--runs", "2", "--workers", "0"]
    command += ["--methods", "aepnp", "--metrics", "depth"]
    line = refusal_line(capsys, *command)
    assert line.startswith("--metrics: unknown metric 'depth'")
    assert main([*command, "--plugin", "my_metrics.py"]) == 0
    assert "depth" in (tmp_path / "runs/simulate_points/summary.csv").read_text()


def test_sets_of_metrics_have_columns_of_their_own() -> None:
    names = [name for name, _ in score_columns(SETS)]
    assert len(names) == len(set(names))
    for each in SETS:
        assert {metric.key for metric in each.medians} <= set(each.columns)
        assert {metric.key for metric in each.shares} <= set(each.columns)


def test_the_table_is_found_where_it_was() -> None:
    assert room.Metric is Metric
    assert room.ROTATION is ROTATION


@pytest.mark.long
def test_the_how_to_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(__file__).parents[2] / "docs" / "how_to" / "own_metric.md"
    (block,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    monkeypatch.chdir(tmp_path)
    space: dict[str, Any] = {}
    exec(block, space)
    assert np.isfinite(space["table"].upright_error).all()


def test_functions_are_metrics_by_their_names() -> None:
    assert simulate(metrics=[depth_error]).depth_error.notna().all()
    assert simulate(metrics=depth_error, methods="epnp").method.tolist() == ["epnp"] * 3
    with pytest.raises(InputError, match="metrics: a function that is called <lambda>"):
        simulate(metrics=[lambda *, est: 0.0])


@pytest.mark.parametrize(
    ("metric", "places", "shares"),
    [(ROTATION, [0.5, 1.0, 9.0], [0, 50, 75]), (BOX_IOU, [0.5, 1.0, 2.5], [75, 75, 25])],
)
def test_curves_count_small_errors_and_large_overlaps(
    metric: Metric, places: list[float], shares: list[float]
) -> None:
    cells = {
        "method": np.array(["mine"] * 4),
        "status": np.array(["ok", "ok", "ok", "failed"]),
        metric.key: np.array([1.0, 1.0, 3.0, np.nan]),
    }
    run: Any = SimpleNamespace(methods=("mine",), cells=cells)
    (trace,) = cumulative([run], metric, np.array(places), title="").traces
    assert list(trace.y) == shares
