"""`cadalign library build` as a run: resumed, shared among processes, failures as rows."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support.refusals import refusal_line

import cadalign.batch.libraries as module
from cadalign import Library
from cadalign.batch.libraries import ModelRows, build_library
from cadalign.cli import main
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.errors import InputError
from cadalign.evaluation.runs.run import Progress
from cadalign.retrieval import LibraryModel


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_sample_dataset(tmp_path / "sample", per_category=4, categories=["chair", "bottle"])


PLY = """ply
format ascii 1.0
element vertex 3
property double x
property double y
property double z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1e60 0 0
0 1 0
3 0 1 2
"""


class Stop(Exception):
    """Stands for the signal that ends a run."""


def test_a_build_that_was_interrupted_goes_on(root: Path, tmp_path: Path) -> None:
    folder, dataset = tmp_path / "build", KeypointNet(root)
    seen: list[Progress] = []

    def stop(progress: Progress) -> None:
        seen.append(progress)
        if progress.done == 5:
            raise Stop

    with pytest.raises(Stop):
        build_library(dataset, folder, on_progress=stop)
    seen.clear()
    library, troubles = build_library(dataset, folder, on_progress=seen.append)
    assert (seen[0].done, troubles) == (5, [])
    library.save(tmp_path / "resumed")
    Library.from_dataset(dataset).save(tmp_path / "whole")
    assert (tmp_path / "resumed").read_bytes() == (tmp_path / "whole").read_bytes()


def test_models_that_cannot_be_read_are_rows(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = root / "annotations" / "chair.json"
    entries = json.loads(path.read_text())
    del entries[0]["keypoints"]
    path.write_text(json.dumps([*entries, entries[1]]))
    mesh = KeypointNet(root)["bottle"][0].mesh_path
    assert mesh is not None
    mesh.write_text("nonsense")
    for _ in range(2):  # a finished build is done anew
        assert main(["library", "build", str(root), "--out", str(tmp_path / "lib")]) == 0
    said = capsys.readouterr().err
    assert "Left out: 2 models with malformed annotations" in said
    assert "Without their meshes, which cannot be read: 1" in said
    rows = pq.read_table(tmp_path / "lib_build" / "results.parquet").to_pylist()
    assert len(rows) == 9
    reasons = [row["reason"] for row in rows if row["status"] == "failed"]
    assert ["missing" in reasons[0], "the model occurs twice" in reasons[1]] == [True, True]
    assert sum(bool(row["warning"]) for row in rows) == 1
    assert len(Library.open(tmp_path / "lib")) == 7


def test_a_build_of_no_model_leaves_its_rows_where_there_are_any(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, folder = root / "annotations" / "chair.json", tmp_path / "lib_build"
    entries = json.loads(path.read_text())
    for text, said in (
        ("[]", f"{root}: the data set has no such models"),
        (
            json.dumps([{"model_id": each["model_id"]} for each in entries]),
            f"{root}: none of 4 models can be read; {folder / 'results.parquet'} has the reasons",
        ),
    ):
        path.write_text(text)
        chairs = ["library", "build", root, "--categories", "chair"]
        assert refusal_line(capsys, *chairs, "--out", tmp_path / "lib") == said
        assert folder.exists() == (text != "[]")


def test_a_library_that_is_written_can_be_opened(root: Path, tmp_path: Path) -> None:
    """Whatever the coordinates: of a keypoint, and of a mesh."""
    path = root / "annotations" / "chair.json"
    entries = json.loads(path.read_text())
    entries[0]["keypoints"][0]["xyz"][0] = 1e300
    path.write_text(json.dumps(entries))
    mesh = KeypointNet(root)["bottle"][0].mesh_path
    assert mesh is not None
    mesh.write_text(PLY)
    dataset = KeypointNet(root)
    library, troubles = build_library(dataset, tmp_path / "build")
    library.save(tmp_path / "lib")
    assert len(Library.open(tmp_path / "lib")) == 7
    assert [row["warning"] for row in troubles if row["category"] == "bottle"] == [
        f"bottle, model {mesh.stem}: a coordinate exceeds 1e+50"
    ]
    with pytest.raises(InputError, match=r"^chair, model a: a coordinate exceeds 1e\+50"):
        LibraryModel("chair", "a", [[1e60, 0, 0]], [0], [[0, 0, 0], [1, 1, 1]])


def test_a_folder_of_another_run_is_refused(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lib_build").mkdir()
    (tmp_path / "lib_build" / "run.json").write_text('{"experiment": "fit"}')
    assert main(["library", "build", str(root), "--out", str(tmp_path / "lib")]) == 1
    assert 'experiment is "fit" there and "library" now' in capsys.readouterr().err


def test_a_folder_of_other_files_is_kept(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "lib_build" / "src" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("work")
    line = refusal_line(capsys, "library", "build", root, "--out", tmp_path / "lib")
    fix = "rename it, or give another --out"
    assert line == f"{tmp_path / 'lib_build'}: holds files that are no run's; {fix}"
    assert [path.name for path in (tmp_path / "lib_build").iterdir()] == ["src"]
    assert notes.read_text() == "work"


def test_files_that_others_put_into_the_run_are_kept(root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "lib_build"
    build_library(KeypointNet(root), folder)
    (folder / "notes.txt").write_text("work")
    assert main(["library", "build", str(root), "--out", str(tmp_path / "lib")]) == 0
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_the_columns_are_documented() -> None:
    assert module.__doc__ is not None
    assert [name for name, _ in ModelRows.columns if name not in module.__doc__] == []
