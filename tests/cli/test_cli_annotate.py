"""`cadalign annotate` from the command line: it starts, says where, ends, and refuses in words."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from support.annotating import Case, make_case
from support.refusals import refusal_line

from cadalign.annotate.server import listen
from cadalign.cli import main


@pytest.fixture(scope="module")
def case(sample_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return make_case(sample_root, tmp_path_factory.mktemp("cli"))


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    return refusal_line(capsys, "annotate", *arguments, "--no-open")


@pytest.mark.long
def test_it_serves_until_interrupted(case: Case) -> None:
    program = "import sys; from cadalign.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "annotate", "--no-open"]
    command += ["--image", str(case.photo), "--model", str(case.model)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        url = process.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{43}", url)
        with urllib.request.urlopen(url, timeout=120) as response:
            assert b"annotate.js" in response.read()
    finally:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert out == ""
    assert err.strip().splitlines()[-1] == f"Saved in {case.folder.absolute()}"


def test_port_in_use(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    with listen(0) as listener:
        port = listener.getsockname()[1]
        message = refusal(capsys, "--image", case.photo, "--model", case.model, "--port", port)
    assert message == (
        f"--port: port {port} cannot be opened (Address already in use); "
        "omit --port to use a free one"
    )


def test_missing_model_and_photo(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = case.folder / "nowhere.obj"
    assert refusal(capsys, "--image", case.photo, "--model", nowhere) == (
        f"{nowhere}: no such mesh file"
    )
    assert refusal(capsys, "--image", nowhere, "--model", case.model) == (
        f"{nowhere}: no such file or folder"
    )
    assert refusal(capsys, "--image", case.camera, "--model", case.model).startswith(
        f"{case.camera}: not an image that can be read ("
    )


def test_out_folder_is_made(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    file = case.folder / "file"
    file.write_text("")
    message = refusal(capsys, "--image", case.photo, "--model", case.model, "--out", file / "out")
    reason = "the folder cannot be created (Not a directory); choose another --out"
    assert message == f"{file / 'out'}: {reason}"


def test_folder_of_the_observation_is_made(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Refused only after the folder was made: a model that is none.
    observation = tmp_path / "new" / "dir" / "obs.json"
    refusal(capsys, "--image", case.photo, "--model", case.camera, "--observation", observation)
    assert observation.parent.is_dir()
    file = tmp_path / "file"
    file.write_text("")
    message = refusal(
        capsys,
        *("--image", case.photo, "--model", case.model),
        *("--observation", file / "sub" / "obs.json"),
    )
    assert message == (
        f"{file / 'sub' / 'obs.json'}: cannot be written (Not a directory); "
        "make room or choose another folder; what was written before is kept"
    )


def test_model_is_required(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["annotate", "--image", "photo.jpg"])
    assert stop.value.code == 2
    assert "--model" in capsys.readouterr().err
