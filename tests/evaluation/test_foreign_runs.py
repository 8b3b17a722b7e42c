"""Folders of runs with damaged, missing or foreign files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.refusals import refusal_line

import cadalign
from cadalign.cli import main
from cadalign.evaluation.api import run as do_run
from cadalign.evaluation.experiments.keypointnet import KeypointNetOptions
from cadalign.evaluation.experiments.simulation import SweepOptions
from cadalign.evaluation.runs.engine import Progress
from cadalign.evaluation.runs.folder import RunFolder

SWEEP = SweepOptions("points", values=(8, 10), runs=40, methods=("aepnp",))
Change = Callable[[Path], None]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished sweep."""
    path = tmp_path_factory.mktemp("finished") / "run"
    do_run(SWEEP, RunFolder(path), workers=0, dask=None)
    return path


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of the sweep, which tests may change."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


@pytest.fixture(scope="module")
def halved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep with one of two chunks finished."""
    path = tmp_path_factory.mktemp("halved") / "run"

    def stop(progress: Progress) -> None:
        if progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        do_run(SWEEP, RunFolder(path), workers=0, dask=None, on_progress=stop)
    return path


def changed(column: str, value: Any, kind: pa.DataType | None = None) -> Change:
    """Replace a column of the result table."""

    def change(run: Path) -> None:
        table = pq.read_table(run / "results.parquet")
        cells = pa.array([value] * len(table), kind)
        index = table.column_names.index(column)
        pq.write_table(table.set_column(index, column, cells), run / "results.parquet")

    return change


def foreign(run: Path) -> None:
    pq.write_table(pa.table({"a": [1, 2], "b": ["x", "y"]}), run / "results.parquet")


def without_method(run: Path) -> None:
    table = pq.read_table(run / "results.parquet")
    pq.write_table(table.drop_columns("method"), run / "results.parquet")


def twice(run: Path) -> None:
    table = pq.read_table(run / "results.parquet")
    pq.write_table(table.append_column("method", table["method"]), run / "results.parquet")


def cut_short(run: Path) -> None:
    path = run / "results.parquet"
    path.write_bytes(path.read_bytes()[:-100])


def cut_timings(run: Path) -> None:
    path = run / "timings.parquet"
    path.write_bytes(path.read_bytes()[:-100])


_ANEW = "; remove it and start the same run again: it is computed again"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "text"),
    [
        (foreign, f"not a valid table of a run: column 'points' is missing{_ANEW}"),
        (without_method, f"not a valid table of a run: column 'method' is missing{_ANEW}"),
        (twice, None),
        (
            changed("rotation_error_deg", "large"),
            "not a valid table of a run: column 'rotation_error_deg' has the type 'string', "
            f"not 'double'{_ANEW}",
        ),
        (
            changed("method", None),
            f"not a valid table of a run: column 'method' has the type 'null', not 'string'{_ANEW}",
        ),
        (
            changed("method", None, pa.string()),
            f"not a valid table of a run: column 'method' has empty cells{_ANEW}",
        ),
        (cut_short, None),
    ],
)
def test_a_foreign_or_damaged_table_of_results_is_refused(
    finished: Path,
    run: Path,
    capsys: pytest.CaptureFixture[str],
    change: Change,
    text: str | None,
) -> None:
    change(run)
    line = refusal_line(capsys, "report", run)
    assert line.startswith(f"{run / 'results.parquet'}: ")
    assert line.endswith(_ANEW)
    if text is not None:
        assert line == f"{run / 'results.parquet'}: {text}"
    # Following the advice repairs the run.
    (run / "results.parquet").unlink()
    do_run(SWEEP, RunFolder(run), workers=0, dask=None)
    assert (run / "results.parquet").read_bytes() == (finished / "results.parquet").read_bytes()


def test_damaged_timings_may_be_removed(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut_timings(run)
    line = refusal_line(capsys, "report", run)
    assert line.endswith("; remove it: the run is shown without times")
    (run / "timings.parquet").unlink()
    assert main(["report", str(run)]) == 0
    sweep = {"sweep": "points", "values": (8, 10), "runs": 40, "methods": ("aepnp",)}
    table = cadalign.evaluate(experiment="simulate", **sweep, workers=0, out=run)
    assert table.seconds.isna().all()


def test_an_unfinished_run_with_a_missing_part_is_shown(
    halved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(halved, run)
    assert main(["report", str(run)]) == 0
    capsys.readouterr()
    (part,) = (run / "parts").iterdir()
    pq.write_table(pa.table({"a": [1]}), part)
    assert "column 'points' is missing" in refusal_line(capsys, "report", run)
    # Parts of another, longer run.
    shutil.copy(halved / "parts" / part.name, part)
    shutil.copy(part, run / "parts" / "0000900.parquet")
    assert main(["report", str(run)]) == 0


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"tasks": "many"}, "tasks: 'many' is not a whole number"),
        ({"tasks": -3}, "tasks: -3 is not a whole number >= 0"),
        ({"chunk_size": 0}, "chunk_size: 0 is not a whole number >= 1"),
        ({"versions": "new"}, "versions: 'new' is not an object"),
        ({"experiment": 3}, "experiment: 3 is not a text"),
        ({"sweep": None}, "sweep: 'None' is not one of noise, points, outliers"),
        ({"sweep": [1]}, "sweep: '[1]' is not one of noise, points, outliers"),
    ],
)
def test_a_hostile_run_file_is_refused_by_field(
    run: Path,
    capsys: pytest.CaptureFixture[str],
    fields: dict[str, Any],
    text: str,
) -> None:
    config = json.loads((run / "run.json").read_text()) | fields
    (run / "run.json").write_text(json.dumps(config))
    line = refusal_line(capsys, "report", run)
    assert line.startswith(f"{run / 'run.json'}: {text}")


@pytest.mark.parametrize("text", ["[" * 100_000, '{"tasks": ' + "9" * 5000 + "}", "\xff", "[1]"])
def test_a_run_file_that_is_none_is_refused(
    run: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    (run / "run.json").write_text(text, encoding="latin-1")
    line = refusal_line(capsys, "report", run)
    assert line.startswith(f"{run / 'run.json'}: ")
    assert len(line) < 600


def _keypointnet(root: Path, out: Path) -> None:
    options = KeypointNetOptions(root, methods=("aepnp",), categories=("chair",))
    do_run(options, RunFolder(out), workers=0, dask=None)


@pytest.mark.long
def test_records_that_are_no_objects_are_refused(
    sample_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    _keypointnet(sample_root, run)
    table = pq.read_table(run / "records.parquet")
    index = table.column_names.index("exhibit")
    for record in ("", "alert(1)", "[1]", "[" * 100_000, "{} alert(1)"):
        cells = pa.array([record] * len(table), pa.string())
        pq.write_table(table.set_column(index, "exhibit", cells), run / "records.parquet")
        line = refusal_line(capsys, "report", run)
        assert "is not an object of JSON; remove it: the run is shown without it" in line
        assert len(line) < 600
    (run / "records.parquet").unlink()
    assert main(["report", str(run)]) == 0
