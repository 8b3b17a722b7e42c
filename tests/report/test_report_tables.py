"""The report's command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from cadalign.cli import main
from cadalign.evaluation.api import run as do_run
from cadalign.evaluation.experiments.simulation import SweepOptions
from cadalign.evaluation.runs.folder import RunFolder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "a_run"
    options = SweepOptions("noise", values=(1, 4), runs=4, methods=("optimal", "aepnp", "limit"))
    do_run(options, RunFolder(out), workers=0, dask=None)
    return out


def test_the_page_goes_into_the_folder_of_a_run_and_of_several_where_one_is(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(run)]) == 0
    assert (run / "report.html").is_file()
    assert f"Report: {run / 'report.html'}" in capsys.readouterr().err.replace("\n", "")
    options = SweepOptions("noise", values=(1,), runs=4, methods=("aepnp",))
    do_run(options, RunFolder(tmp_path / "b"), workers=0, dask=None)
    monkeypatch.chdir(tmp_path)
    assert main(["report", str(run), "b"]) == 0
    assert (tmp_path / "report.html").is_file()
    assert main(["report", str(run), "/nowhere"]) == 1
    assert "/nowhere: no such folder" in capsys.readouterr().err
