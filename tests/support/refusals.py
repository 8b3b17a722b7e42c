"""Calls and commands that must be refused, and the message that they are refused with."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from cadalign.cli import main
from cadalign.errors import CadalignError


def refusal(act: Callable[[], object]) -> CadalignError:
    """The package's error that a call ends in."""
    with pytest.raises(CadalignError) as caught:
        act()
    return caught.value


def refusal_text(act: Callable[[], object]) -> str:
    """The message of the package's error that a call ends in."""
    return str(refusal(act))


def assert_messages(path: Path, calls: Mapping[str, Callable[[], object]]) -> None:
    """Assert that calls are refused as a file says: their names, kinds of errors and messages.

    With ``SNAPSHOTS=write`` in the environment the file is written anew.
    """
    found = {}
    for name, call in calls.items():
        try:
            error = refusal(call)
        except BaseException as failure:
            failure.add_note(f"call: {name}")
            raise
        found[name] = f"{type(error).__name__}: {error}"
    if os.environ.get("SNAPSHOTS") == "write":
        path.write_text(json.dumps(found, indent=0, ensure_ascii=False) + "\n", encoding="utf-8")
    assert found == json.loads(path.read_text(encoding="utf-8"))


def refusal_line(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must be refused; its one line on standard error, without the name."""
    assert main([str(argument) for argument in arguments]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("cadalign: ")
    assert captured.err.count("\n") == 1
    assert captured.err.endswith("\n")
    return captured.err.removeprefix("cadalign: ").removesuffix("\n")
