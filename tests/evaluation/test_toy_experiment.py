"""An experiment in this file only: its run, tables, page, and figures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest
import tyro

import cadalign
from cadalign.arrays import instance_rng
from cadalign.cli import main
from cadalign.evaluation import registry
from cadalign.evaluation.metrics import FAILED, INSTANCES, Metric
from cadalign.evaluation.options import ExperimentOptions
from cadalign.evaluation.plots import Plot, Trace
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run
from cadalign.evaluation.runs.work import Columns, Outcome, Plan, Row
from cadalign.evaluation.summary import medians, summarize
from cadalign.report import write_report

# --- the experiment: estimate the centre of noisy numbers -------------------------------------

ERROR = Metric("middle_error", "error of the middle", "mm", digits=1, factor=1000.0)
DRAWS = Metric("draws", "numbers", better=None)
COLUMNS: Columns = (
    *(("category", str), ("model_id", int), ("method", str)),
    *(("status", str), ("reason", str), (ERROR.key, float)),
)


@dataclass(frozen=True)
class MiddleOptions(ExperimentOptions):
    """Estimate the centre of noisy numbers."""

    experiment: ClassVar[str] = "middle"

    root: Annotated[Path, tyro.conf.Positional]
    """File with the categories, a line each."""
    _: KW_ONLY
    draws: int = 5
    """Numbers for each task."""
    tasks: int = 6
    """Tasks of each category."""
    methods: tuple[str, ...] = ("mean", "median")
    """mean, median."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(draws=1, tasks=1)


@dataclass(frozen=True)
class Middle:
    options: MiddleOptions

    @property
    def columns(self) -> Columns:
        return COLUMNS

    record_columns: ClassVar[Columns] = ()

    def evaluate(self, tasks: Sequence[tuple[str, int]]) -> list[Row]:
        return [outcome.row() for task in tasks for outcome in self._outcomes(*task)]

    def failure(self, task: tuple[str, int], reason: str) -> list[Row]:
        methods = self.options.methods
        return [Outcome(names(*task, m), status="failed", reason=reason).row() for m in methods]

    def _outcomes(self, category: str, number: int) -> Iterator[Outcome]:
        rng = instance_rng(self.options.seed, category, str(number))
        values = rng.normal(0, 1, self.options.draws)
        if category == "bad":
            raise ValueError("no numbers")
        for method in self.options.methods:
            error = abs(float(getattr(np, method)(values)))
            yield Outcome(names(category, number, method), {ERROR.key: error}, seconds=0.1)


def names(category: str, number: int, method: str) -> dict[str, Any]:
    return {"category": category, "model_id": number, "method": method}


def plan(options: MiddleOptions, folder: RunFolder) -> Plan[tuple[str, int]]:
    categories = options.root.read_text().split()
    tasks = [(category, k) for category in categories for k in range(options.tasks)]
    config = {**asdict(options), "experiment": "middle", "root": str(options.root)}
    return Plan(Middle(options), tasks, config, chunk_size=4)


def plots(runs: Sequence[Run]) -> list[Plot]:
    traces = [
        Trace.from_values(
            index, line.method, [some.config["draws"]], [line.values[ERROR.key]], ERROR
        )
        for index, some in enumerate(runs)
        for line in summarize(some, medians(ERROR))
    ]
    return [Plot("middle", DRAWS, ERROR, traces)]


SPEC = Spec(
    options=MiddleOptions,
    plan=plan,
    columns=(INSTANCES, FAILED, ERROR),
    summarize=partial(summarize, statistics=medians(ERROR)),
    plots=plots,
    note="Medians of toys.",
)


# --- what it gets without another file ---------------------------------------------------------


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry._EXPERIMENTS, "middle", __name__)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    path = tmp_path / "categories"
    path.write_text("bad\ncup\nspoon\n")
    return path


@pytest.mark.long
def test_it_is_a_command(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["evaluate", "middle", "--help"])
    text = capsys.readouterr().out
    assert "Numbers for each task." in text
    assert "Address of a Dask scheduler" in text
    out = tmp_path / "run"
    arguments = ["evaluate", "middle", str(root), "--draws", "9", "--workers", "0"]
    assert main([*arguments, "--out", str(out)]) == 3
    shown = capsys.readouterr()
    (line,) = [line for line in shown.out.splitlines() if "spoon" in line and "mean" in line]
    error = np.median(
        [abs(instance_rng(0, "spoon", str(k)).normal(0, 1, 9).mean()) for k in range(6)]
    )
    assert line.replace("│", " ").split() == ["spoon", "mean", "6", "0", f"{1000 * error:.1f}"]
    assert "12 of 36 rows failed" in shown.err
    assert "failed 12: ValueError: no numbers" in shown.err
    assert main(["evaluate", "middle", str(root), "--draws", "0", "--out", str(out)]) == 1
    assert "--draws: 0 is less than 1" in capsys.readouterr().err


def test_random_streams_do_not_change_between_versions() -> None:
    assert instance_rng(0, "chair", "88382b87").integers(0, 1000, 3).tolist() == [731, 850, 330]
    assert instance_rng(2**40, "").integers(0, 1000, 3).tolist() == [98, 254, 354]


def test_it_has_a_table_a_page_figures_and_a_data_frame(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    table = cadalign.evaluate(root, "middle", methods=["mean"], workers=0, out=out)
    assert table.groupby("category").status.first().to_dict() == {
        "bad": "failed",
        "cup": "ok",
        "spoon": "ok",
    }
    page = write_report([out], tmp_path / "page.html").read_text()
    payload = json.loads(page.split('id="payload">')[1].split("</script>")[0])
    assert payload["title"] == "Middle on categories"
    columns = [column["label"] for column in payload["headline"]["columns"]]
    assert columns == ["instances", "failed", "error of the middle"]
    assert payload["headline"]["note"] == "Medians of toys."
    assert payload["headline"]["failures"][0]["reason"] == "ValueError: no numbers"
    assert payload["plots"][0]["y"] == {"label": "error of the middle", "unit": "mm", "log": True}
    assert ["draws", "5"] in payload["runs"][0]["settings"]
