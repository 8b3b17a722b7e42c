"""Calls and commands that must be refused, and the message that they are refused with."""

from __future__ import annotations

from collections.abc import Callable

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


def refusal_line(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must be refused; its one line on standard error, without the name."""
    assert main([str(argument) for argument in arguments]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("cadalign: ")
    assert captured.err.count("\n") == 1
    assert captured.err.endswith("\n")
    return captured.err.removeprefix("cadalign: ").removesuffix("\n")
