"""One annotator per folder: the refusal of a second one, and the files of a stopped one."""

from __future__ import annotations

import http.client
import json
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.annotating import Case, place, place_all
from support.forked import MAIN, Program
from support.refusals import refusal_line

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.io import files
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long


class Annotator:
    """A process of `cadalign annotate`."""

    def __init__(self, process: Program) -> None:
        assert process.stdout is not None
        self.process = process
        url = process.stdout.readline().strip()
        match = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=(.+)", url)
        assert match, process.communicate()[1]
        self.port, self.token = int(match[1]), match[2]

    def act(self, action: dict[str, Any]) -> dict[str, Any]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        cookie = f"cadalign-{self.port}={self.token}"
        headers = {"Cookie": cookie, "Content-Type": "application/json"}
        connection.request("POST", "/act/0", body=json.dumps(action), headers=headers)
        answer: dict[str, Any] = json.loads(connection.getresponse().read())
        connection.close()
        return answer

    def end(self, how: signal.Signals = signal.SIGINT) -> tuple[int, str]:
        self.process.send_signal(how)
        _, err = self.process.communicate(timeout=60)
        status = self.process.poll()
        assert status is not None
        return status, err


@contextmanager
def annotator(case: Case, photo: Path, *arguments: object) -> Iterator[Annotator]:
    """An annotator in a process of its own."""
    given = ["annotate", photo, case.model, "--no-open", "--camera", case.camera, *arguments]
    process = Program(MAIN, *given)
    try:
        yield Annotator(process)
    finally:
        process.kill()
        process.communicate()


def second(case: Case, capsys: pytest.CaptureFixture[str], photo: Path, *arguments: object) -> str:
    """Start a second annotator; returns its error."""
    given = photo, case.model, "--no-open", "--camera", case.camera, *arguments
    return refusal_line(capsys, "annotate", *given)


# --- processes -------------------------------------------------------------------------------


def test_second_process_is_refused_and_a_killed_one_leaves_no_lock(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    with annotator(case, case.photo) as first:
        first.act({"do": "place_uv", "uv": [10, 20]})
        first.act({"do": "pick", "origin": [0.02, 3, 0.03], "direction": [0, -1, 0]})
        message = second(case, capsys, case.photo)
        assert message == (
            f"{case.folder}: another annotator has this folder open; "
            "use or close its page, or give another --observation or --out"
        )
        assert second(case, capsys, case.folder) == message
        first.act({"do": "place_uv", "uv": [30, 40]})
        first.process.send_signal(signal.SIGKILL)
        first.process.wait()
    assert Observation.load(case.observation).points_2d.tolist() == [[10, 20]]
    with annotator(case, case.photo) as third:
        pairs = third.act({"do": "place_uv", "uv": [50, 60]})["pairs"]
        assert [pair["uv"] for pair in pairs] == [[10, 20], [30, 40], [50, 60]]
        code, err = third.end(signal.SIGTERM)
    assert (code, err.strip().splitlines()[-1]) == (0, f"Saved in {case.folder}")


def test_folder_keeps_annotators_of_its_photos_out(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    out = case.folder / "out"
    with annotator(case, case.folder, "--out", out) as first:
        for photo, *arguments in (
            (case.folder, "--out", out),
            (case.photo, "--out", out),
            (case.photo, "--observation", out / "photo.json"),
        ):
            message = second(case, capsys, photo, *arguments)
            assert message.startswith(f"{out}: another annotator has this folder open")
        with annotator(case, case.photo) as elsewhere:  # another folder's files
            elsewhere.act({"do": "undo"})
            assert elsewhere.end()[0] == 0
        first.act({"do": "undo"})
        assert first.end()[0] == 0
    assert [path.name for path in out.iterdir()] == [".annotate-lock"]


# --- several photos, several tabs --------------------------------------------------------------


def test_pairs_of_a_renamed_photo_go_on(case: Case) -> None:
    session = case.open()
    place(session, 0, [10, 20])
    renamed = case.photo.rename(case.folder / "renamed.png")
    place(session, 1, [30, 40])
    assert page_state(session, 0)["saved"]["trouble"] == ""
    again = case.open(image=renamed, observation=case.observation)
    assert len(page_state(again, 0)["pairs"]) == 2
    perform(again, 0, {"do": "delete", "pair": 2})
    assert Observation.load(case.observation).image == renamed


# --- stopped in the middle of an action ----------------------------------------------------------


class Stop(BaseException):
    """The end of a process in the middle of a write."""


def content(state: dict[str, Any]) -> dict[str, Any]:
    """The user's input in a state of the page."""
    pairs = [[pair["uv"], pair["keypoint"], pair["name"]] for pair in state["pairs"]]
    evidence = state["evidence"]
    return {
        "pairs": sorted(map(json.dumps, pairs)),
        "evidence": [evidence["mask"] is not None, evidence["photo"]],
    }


@pytest.mark.parametrize(
    "action",
    [
        "place_keypoint",
        "release",
        "move",
        "delete",
        "undo",
        "rename",
        "mask_cut",
        "use_photo",
    ],
)
def test_stopped_before_any_write_an_action_is_done_or_not(
    case: Case, action: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process ends at each write of an action, in turn."""
    arguments: dict[str, dict[str, Any]] = {
        "place_keypoint": {"keypoint": case.clicks[4][0]},
        "release": {"pair": 2},
        "move": {"pair": 5, "uv": [50.0, 60.0]},
        "delete": {"pair": 5},
        "rename": {"pair": 1, "name": "knee"},
        "mask_cut": {"corners": [[150, 80], [450, 420]]},
        "use_photo": {"on": True},
    }
    write, written = files.write_whole, [0]

    def stopping(path: Path, how: Any, *, after: int = -1) -> None:
        if written[0] == after:
            raise Stop
        written[0] += 1
        write(path, how)

    for number in range(9):
        for path in case.folder.glob("photo*.json"):
            path.unlink()
        session = case.open(prepared=False)
        place_all(session, case, count=4)
        perform(session, 0, {"do": "place_uv", "uv": case.clicks[4][1]})
        before = content(page_state(session, 0))
        written[0] = 0
        with monkeypatch.context() as patched:
            patched.setattr(
                files, "write_whole", lambda path, how, n=number: stopping(path, how, after=n)
            )
            stopped = False
            try:
                perform(session, 0, {"do": action, **arguments.get(action, {})})
            except Stop:
                stopped = True
        after = content(page_state(session, 0))
        found = content(page_state(case.open(prepared=False), 0))
        assert found in (before, after), (number, json.dumps([before, found, after], indent=1))
        if not stopped:
            return
    pytest.fail("it never came to an end")
