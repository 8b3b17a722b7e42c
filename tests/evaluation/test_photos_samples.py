"""`cadalign evaluate photos` on samples of the public data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cadalign.evaluation.api import run
from cadalign.evaluation.experiments.photos import SPEC, PhotosOptions
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run

pytestmark = pytest.mark.long


def evaluated(root: Path, out: Path, **options: Any) -> Run:
    """A finished run; skips the test without the sample."""
    if not root.is_dir():
        pytest.skip(f"CADALIGN_DATA has no {root.name}")
    options = {"pictures": 3, **options}
    run(PhotosOptions(root, **options), RunFolder(out), workers=0, dask=None)
    return SPEC.open(out)


def line_of(found: Run, group: str, method: str) -> dict[str, Any]:
    """The summary of a method on a category."""
    (line,) = (
        each for each in SPEC.summarize(found) if (each.group, each.method) == (group, method)
    )
    return line.values


def test_chairs_of_scan2cad_are_aligned(real_data: Path, tmp_path: Path) -> None:
    found = evaluated(real_data / "real/scan2cad", tmp_path, methods=("rigid", "similar"))
    line = line_of(found, "chair", "similar")
    assert (line["instances"], line["failed"], line["left_out"]) == (2, 0, 1)
    assert line["rotation_error_deg"] <= 5
    assert line["scan2cad_aligned"] == 1.0
