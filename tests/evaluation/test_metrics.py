"""User metrics: a function is a column of tables, summaries and pages."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.pages import embedded_payload
from support.solving import broken, depth_error, linear

import cadalign
from cadalign.cli import main
from cadalign.errors import DataError, InputError
from cadalign.evaluation.methods import FunctionMetric
from cadalign.evaluation.metrics import BOX_IOU, ROTATION, Metric
from cadalign.evaluation.plots import cumulative_plot


def simulate(**options: Any) -> Any:
    options = {"values": [20], "runs": 3, "methods": ["aepnp"], "workers": 0, **options}
    return cadalign.evaluate(experiment="simulate", sweep="points", **options)


@pytest.mark.parametrize("given", [depth_error, "support.solving:depth_error"])
def test_a_function_is_a_column(given: Any) -> None:
    table = simulate(metrics=[given])
    assert (table.depth_error > 0).all()
    assert (table.depth_error <= table.translation_error).all()
    assert "depth_error" not in simulate().columns


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
def test_a_function_is_shown_like_other_metrics(
    sample_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    options: dict[str, Any] = {
        "methods": ["optimal", "aepnp"],
        "metrics": [depth_error, "support.solving:spread"],
    }
    table = cadalign.evaluate(sample_root, out=out, workers=1, **options)
    assert table[table.method == "aepnp"].spread.isna().all()
    assert (table[table.method == "optimal"].spread > 0).all()
    command = ["evaluate", "keypointnet", str(sample_root), "--out", str(out)]
    command += ["--methods", "optimal", "aepnp"]
    command += ["--metrics", "support.solving:depth_error", "support.solving:spread"]
    assert main(command) == 0
    assert "depth error" in capsys.readouterr().out
    with (out / "summary.csv").open() as file:
        (row,) = (
            row
            for row in csv.DictReader(file)
            if (row["category"], row["method"]) == ("car", "aepnp")
        )
    chosen = table[(table.category == "car") & (table.method == "aepnp")]
    assert float(row["depth_error"]) == pytest.approx(chosen.depth_error.median())
    assert main(["report", str(out)]) == 0
    page = embedded_payload(out / "report.html")
    assert [metric["key"] for metric in page["metrics"]][-2:] == ["depth_error", "spread"]
    assert "depth error" in [column["label"] for column in page["headline"]["columns"]]


@pytest.mark.long
def test_every_experiment_with_functions_takes_a_metric(real_data: Path) -> None:
    def depth_off(*, est: Any, gt: Any) -> float:
        return depth_error(est=est, gt=gt)

    common: dict[str, Any] = {"metrics": [depth_off], "workers": 0}
    for root, experiment, options in (
        (real_data / "real/scan2cad", "photos", {"methods": ["rigid", linear]}),
        (
            real_data / "keypointnet",
            "unseen",
            {"methods": ["shape", linear], "categories": ["mug"], "max_models": 2},
        ),
        (
            real_data / "sfm/maupertuis_colmap",
            "correspondences",
            {"methods": ["aepnp", linear], "draws": 1, "outliers": [0.0]},
        ),
    ):
        table = cadalign.evaluate(root, experiment, **common, **options)
        solved = table[table.status == "ok"]
        assert solved.depth_off.notna().all()
        assert set(solved.method) == set(table.method)
        assert "linear" in set(table.method)


def test_an_error_of_a_metric_is_the_reason_of_its_rows() -> None:
    assert set(simulate(metrics=[broken]).reason) == {"metric broken: RuntimeError: divided"}

    def answers(value: Any) -> Any:
        def constant(*, est: Any) -> Any:
            return value

        return simulate(metrics=[constant])

    assert set(answers("far").reason) == {"metric constant: it returned str, no number"}
    for value, text in ((float("inf"), "inf"), (10**400, "1000")):
        (reason,) = set(answers(value).reason)
        assert reason.startswith(f"metric constant: it returned {text}")
        assert reason.endswith(", which is not finite")
    for value in (None, float("nan")):
        assert answers(value).constant.isna().all()


def test_a_run_does_not_continue_without_its_metrics(tmp_path: Path) -> None:
    simulate(metrics=[depth_error], out=tmp_path / "run")
    simulate(metrics=["support.solving:depth_error"], out=tmp_path / "run")
    with pytest.raises(DataError, match="another configuration: metric"):
        simulate(out=tmp_path / "run")


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (3, "metrics: 3 is no function; give module:function"),
        ("depth", "metrics: 'depth' is no function; give module:function"),
        (
            lambda alignment: 0.0,
            "metrics: unknown parameter 'alignment'; known are est, gt, result, points_3d, "
            "points_2d, camera, sigma, bounds",
        ),
    ],
)
def test_invalid_metrics_are_refused(function: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        FunctionMetric.from_function(function)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    "name", ["rotation_error_deg", "failed", "instances", "success_5deg_5pct", "over_limit"]
)
def test_names_of_columns_are_refused(sample_root: Path, name: str) -> None:
    def function(*, est: Any) -> float:
        return 0.0

    function.__name__ = name
    with pytest.raises(InputError, match=f"metrics: the name '{name}' is already in use; rename"):
        cadalign.evaluate(sample_root, metrics=[function], workers=0)


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["0", "2"])
@pytest.mark.usefixtures("no_figures")
def test_prints_of_a_module_are_not_in_the_output(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    workers: str,
) -> None:
    (tmp_path / "chatty.py").write_text(
        "print('at import')\n"
        "def depth(*, est):\n"
        "    print('hello')\n"
        "    return est.translation[2]\n"
    )
    monkeypatch.chdir(tmp_path)
    command = ["simulate", "points", "--values", "8", "--runs", "2", "--workers", workers]
    command += ["--methods", "aepnp", "--metrics", "chatty:depth", "--json"]
    assert main(command) == 0
    printed = capfd.readouterr()
    assert json.loads(printed.out)["failed"] == 0
    assert "at import" in printed.err
    assert "hello" in printed.err


@pytest.mark.long
def test_the_how_to_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(__file__).parents[2] / "docs" / "how_to" / "own_method.md"
    _, block = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    monkeypatch.chdir(tmp_path)
    space: dict[str, Any] = {}
    exec(block, space)
    assert np.isfinite(space["table"].upright_error).all()


@pytest.mark.parametrize(
    ("metric", "places", "shares"),
    [
        (ROTATION, [0.5, 1.0, 9.0], [0, 50, 75]),
        (BOX_IOU, [0.5, 1.0, 2.5], [75, 75, 25]),
        (replace(ROTATION, key="s_y", factor=100.0), [0.5, 1.0, 9.0], [0, 50, 75]),
    ],
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
    (trace,) = cumulative_plot([run], metric, np.array(places), title="").traces
    assert list(trace.y) == shares
    assert trace.x == [metric.factor * place for place in places]
