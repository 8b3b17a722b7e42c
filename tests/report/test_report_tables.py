"""The report's command line, and its table as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pytest

from cadalign.cli import main
from cadalign.errors import InputError
from cadalign.evaluation.api import run as do_run
from cadalign.evaluation.experiments.simulation import SweepOptions
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.report import FORMATS, headline_text
from cadalign.report.headline import Headline, HeadlineRow, table_text

HOSTILE = "a|b_c\\ & 50 % #1 {x} ~^$ <img src=x onerror=alert(1)> *`[]\nnext"
COLUMNS = (Metric("n", "instances", digits=0, better=None), Metric("r", "R error", "deg", digits=3))


def headline(category: str = "chair") -> Headline:
    rows = [
        HeadlineRow(0, category, "optimal", {"n": 3.0, "r": 0.12345}, ("r",)),
        HeadlineRow(0, category, "epnp", {"n": 3.0, "r": 10.0}),
        HeadlineRow(0, "all", "limit", {"n": 3.0, "r": None}),
    ]
    return Headline("category", COLUMNS, rows, note="Medians, in %.")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "a_run"
    options = SweepOptions("noise", values=(1, 4), runs=4, methods=("optimal", "aepnp", "limit"))
    do_run(options, RunFolder(out), workers=0, dask=None)
    return out


def test_markdown_has_best_values_bold() -> None:
    assert table_text(headline(), ["run"], format="md") == (
        "| category | method | instances | R error \\[deg\\] |\n"
        "| --- | --- | ---: | ---: |\n"
        "| chair | optimal | 3 | **0.123** |\n"
        "| chair | epnp | 3 | 10.000 |\n"
        "| all | limit | 3 | - |\n"
        "\n"
        "Medians, in %.\n"
    )


def test_csv_has_all_digits_and_the_methods_names() -> None:
    rows = list(csv.reader(io.StringIO(table_text(headline(), ["run"], format="csv"))))
    assert rows == [
        ["category", "method", "instances", "R error [deg]"],
        ["chair", "optimal", "3.0", "0.12345"],
        ["chair", "epnp", "3.0", "10.0"],
        ["all", "limit", "3.0", ""],
    ]


def test_names_cannot_break_a_table() -> None:
    markdown = table_text(headline(HOSTILE), ["run"], format="md")
    table = markdown.split("\n\n")[0]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()} == {5}
    assert "<img" not in markdown
    text = table_text(headline(HOSTILE), ["run"], format="csv")
    rows = list(csv.reader(io.StringIO(text, newline="")))
    assert rows[1][0] == HOSTILE


def test_several_runs_are_told_apart_in_every_format(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "b_run"
    options = SweepOptions("noise", values=(1,), runs=4, methods=("aepnp",))
    do_run(options, RunFolder(other), workers=0, dask=None)
    for format, names in (("md", "a\\_run"), ("csv", "a_run")):
        text = headline_text([run, other], format=format)
        assert text.count(names) == 6
        assert text.count(names.replace("a", "b", 1)) == 1
        assert len(re.findall(r"\brun\b", text.splitlines()[0])) == 1


def test_the_command_prints_a_table_or_writes_it(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for format in FORMATS:
        assert main(["report", str(run), "--format", format]) == 0
        printed = capsys.readouterr().out
        assert printed == headline_text([run], format=format)
        out = tmp_path / f"table.{format}"
        assert main(["report", str(run), "--format", format, "--out", str(out)]) == 0
        assert out.read_text(encoding="utf-8") == printed
        assert capsys.readouterr().out == ""


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


def test_an_unknown_format_is_named(run: Path) -> None:
    with pytest.raises(InputError, match="unknown format 'pdf'; known are md, csv"):
        headline_text([run], format="pdf")
