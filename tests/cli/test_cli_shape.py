"""`cadalign shape`: learn from a data set, show, refuse."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.refusals import refusal_line

from cadalign import ShapeModel
from cadalign.cli import main
from cadalign.datasets import write_sample_dataset


@pytest.mark.long
def test_learn_and_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample_root = write_sample_dataset(tmp_path / "sample", per_category=5, categories=["chair"])
    out = tmp_path / "shapes" / "chair.shape"
    assert main(["shape", "learn", str(sample_root), "--category", "chair", "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert f"Written: {out}" in captured.err
    model = ShapeModel.open(out)
    assert model.category == "chair"
    assert model.up_axis == "y"
    assert model.unit == "diagonal"
    assert model.training is not None
    assert model.training.mesh_paths[0] is not None

    assert main(["shape", "show", str(out)]) == 0
    shown = capsys.readouterr().out
    assert f"chair: {len(model.ids)} keypoints, learned from {len(model.training)} models" in shown
    assert "component 1" in shown


def test_refusals(sample_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refusal_line(capsys, "shape", "learn", sample_root, "--category", "zebra")
    assert "zebra" in line
    line = refusal_line(capsys, "shape", "learn", sample_root, "--category", "chair")
    assert line == "models of chair: 1 are too few to learn a shape from; give at least 4"
    line = refusal_line(
        capsys, "shape", "learn", sample_root, "--category", "chair", "--split", "none"
    )
    assert "unknown split 'none'" in line
    learning = ["shape", "learn", sample_root, "--category", "chair"]
    annotations = sample_root / "annotations" / "chair.json"
    before = annotations.read_bytes()
    for path in (annotations, sample_root / "splits" / "train.txt"):
        line = refusal_line(capsys, *learning, "--out", path)
        assert line == f"{path}: this file is an input and would be overwritten; give another name"
        line = refusal_line(capsys, "library", "build", sample_root, "--out", path)
        assert line == f"{path}: this file is an input and would be overwritten; give another name"
    assert annotations.read_bytes() == before
    wrong = tmp_path / "wrong.shape"
    wrong.write_text("no shape")
    line = refusal_line(capsys, "shape", "show", wrong)
    assert line == f"{wrong}: not a shape file; learn it with: cadalign shape learn"
