"""Stopped in the middle of an action, the annotator loses nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support.annotating import Case, place_all

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.io import files


class Stop(BaseException):
    """The end of a process in the middle of a write."""


def content(state: dict[str, Any]) -> dict[str, Any]:
    """What a person has put in, of a state of the page."""
    pairs = [[pair["uv"], pair["keypoint"], pair["name"]] for pair in state["pairs"]]
    evidence = state["evidence"]
    return {
        "pairs": sorted(map(json.dumps, pairs)),
        "evidence": [evidence["mask"] is not None, evidence["photo"]],
    }


@pytest.mark.long
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
    """Every file that an action writes is the last one, in turn."""
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
            for module in ("cadalign.io.files",):
                patched.setattr(
                    f"{module}.write_whole",
                    lambda path, how, n=number: stopping(path, how, after=n),
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
