"""The paper's simulation: problems, tables, figures, the command line."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cadalign
from cadalign.cli import main
from cadalign.errors import InputError
from cadalign.evaluation.experiments.simulation import (
    SWEEPS,
    SweepOptions,
    SweepProblems,
    sweep_benchmark,
    sweep_tasks,
)
from cadalign.evaluation.simulation import simulate_problem


def simulate(sweep: str, **options: Any) -> Any:
    return cadalign.evaluate(experiment="simulate", sweep=sweep, workers=0, **options)


def test_outliers_have_the_given_share_and_random_pixels() -> None:
    rng = np.random.default_rng(0)
    problem = simulate_problem(rng, points=200, noise_px=0.0, outlier_share=0.3)
    assert problem.outliers is not None
    assert problem.outliers.sum() == 60
    projected = problem.camera.project(problem.alignment.apply(problem.points_3d))
    moved = np.linalg.norm(projected - problem.points_2d, axis=1) > 1e-9
    assert (moved == problem.outliers).all()
    assert problem.camera.contains(problem.points_2d[problem.outliers]).all()
    assert np.ptp(problem.points_2d[problem.outliers], axis=0) == pytest.approx([640, 480], rel=0.1)


def test_a_problem_does_not_depend_on_its_neighbours() -> None:
    options = {"values": (1, 3), "runs": 4, "methods": ("optimal", "limit")}
    kind = SweepOptions("noise", **options).kind
    experiment = sweep_benchmark(kind, seed=3)
    tasks = sweep_tasks(kind)
    together = experiment.evaluate(tasks)
    alone = [row for task in tasks for row in experiment.evaluate([task])]
    for row in (*together, *alone):
        del row["seconds"]
    assert together == alone
    assert [row["noise_px"] for row in together[::2]] == [1.0] * 4 + [3.0] * 4


def test_another_seed_gives_other_problems() -> None:
    kind = SweepOptions("points", values=(8,)).kind
    first, other = (SweepProblems("points", seed).problem(sweep_tasks(kind)[0]) for seed in (0, 1))
    assert not np.array_equal(first.points_2d, other.points_2d)


def test_failures_are_rows_with_reasons() -> None:
    table = simulate("points", values=[4, 8], runs=3, methods=["aepnp", "optimal"])
    few = table[(table.points == 4) & (table.method == "aepnp")]
    assert (few.status == "failed").all()
    assert few.reason.str.contains("at least 6").all()
    assert (table[table.points == 8].status == "ok").all()


@pytest.mark.parametrize(
    ("sweep", "options", "message"),
    [
        ("noises", {}, "known are noise, points"),
        ("noise", {"values": [-1]}, "not a noise level"),
        ("noise", {"values": []}, "none is given"),
        ("points", {"values": [3]}, "not a number of points"),
        ("points", {"values": [8.5]}, "not a number of points"),
        ("outliers", {"values": [1.0]}, "not a share"),
        ("points", {"runs": 0}, "runs: 0 is less than 1"),
        ("noise", {"values": [float("nan")]}, "not a noise level"),
    ],
)
def test_bad_options_are_named(sweep: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SweepOptions(sweep, **options)


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("sweep", list(SWEEPS))
def test_the_command_writes_a_table_and_a_figure_for_each_metric(
    sweep: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    values = {"noise": "1", "points": "10", "outliers": "0.2"}[sweep]
    options = ["--runs", "4", "--workers", "0", "--out", str(out), "--json"]
    code = main(["simulate", sweep, "--values", values, *options])
    printed = json.loads(capsys.readouterr().out)
    assert code in (0, 3)
    assert (code == 3) == (printed["failed"] > 0)
    with (out / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["rotation_error_deg"]) > 0
    assert len(rows) == len(SWEEPS[sweep].methods) == len(printed["summary"])
    for metric in ("rotation_error_deg", "scale_z_error"):
        for ending in ("png", "pdf"):
            assert (out / "figures" / f"{metric}.{ending}").is_file()
