"""`cadalign annotate` from the command line: start, address, end, and refusals."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.annotating import Case, make_case
from support.refusals import refusal_line


@pytest.fixture(scope="module")
def case(sample_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return make_case(sample_root, tmp_path_factory.mktemp("cli"))


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    return refusal_line(capsys, "annotate", *arguments, "--no-open")


def test_out_folder_is_made(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    file = case.folder / "file"
    file.write_text("")
    message = refusal(capsys, case.photo, case.model, "--out", file / "out")
    assert message.startswith(f"{file / 'out'}: cannot be written (Not a directory); ")


def test_folder_of_the_observation_is_made(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The model is refused after the folder was made.
    observation = tmp_path / "new" / "dir" / "obs.json"
    refusal(capsys, case.photo, case.camera, "--observation", observation)
    assert observation.parent.is_dir()
    file = tmp_path / "file"
    file.write_text("")
    path = file / "sub" / "obs.json"
    message = refusal(capsys, case.photo, case.model, "--observation", path)
    assert message == (
        f"{path}: cannot be written (Not a directory); "
        "make room or choose another folder; what was written before is kept"
    )
