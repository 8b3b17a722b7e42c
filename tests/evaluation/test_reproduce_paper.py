"""The script that reproduces the paper's tables and figures."""

from __future__ import annotations

import csv
import importlib
import re
from dataclasses import replace
from pathlib import Path

import pytest

from cadalign.evaluation.experiments.simulation import SWEEPS, SweepKind

SCRIPT = Path(__file__).parents[2] / "scripts" / "reproduce_paper.py"


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
def test_everything_is_in_one_folder_beside_the_papers_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small: dict[str, SweepKind] = {
        "noise": replace(SWEEPS["noise"], values=(1.0, 5.0), points=30, runs=5),
        "points": replace(SWEEPS["points"], values=(8, 20), runs=5),
    }
    for name, kind in small.items():
        monkeypatch.setitem(SWEEPS, name, kind)
    monkeypatch.delitem(SWEEPS, "outliers")
    monkeypatch.syspath_prepend(SCRIPT.parent)
    script = importlib.import_module(SCRIPT.stem)
    plan = script.PaperPlan(out=tmp_path, quick=True, workers=0)
    report = script.reproduce_paper(plan).read_text()
    assert "fractions" in report
    for picture in ("noise/figures/rotation_error_deg", "points/figures/scale_z_error"):
        assert f"simulate_{picture}.png" in report
    for link in (part.split(")")[0] for part in report.split("](")[1:]):
        assert (tmp_path / link).is_file(), link
    assert len(re.findall(r"^\| :?---", report, re.M)) == 3
    with (tmp_path / "table1.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["category"] == "all"
    stated = [row for row in rows if "stated" in row["method"]]
    assert {row["category"] for row in stated} == set(script.PAPER_TABLE)
    chair = next(row for row in stated if row["category"] == "chair")
    assert (chair["R [deg]"], chair["s1 (y) [%]"], chair["keypoints"]) == ("0.998", "0.8", "7")
    ours = {(row["category"], row["method"]): float(row["R [deg]"]) for row in rows}
    for category in script.PAPER_TABLE:
        assert ours[category, "optimal"] < ours[category, "aepnp-paper"]
