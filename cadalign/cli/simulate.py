"""`cadalign simulate`: the AEPnP paper's simulation, and figures like its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from cadalign.cli.evaluate import MethodsCommand, command_of, one_of
from cadalign.evaluation.experiments.simulation import SweepOptions

_ABOUT = {
    "noise": "Errors against the keypoints' noise, at 1,024 points.",
    "points": "Errors against the number of points, at 2 px noise.",
    "outliers": "Errors against the share of outliers, at 100 points and 2 px noise.",
    "runtime": "Time of one call against the number of points.",
}


def _commands() -> Any:
    """The command of every sweep."""
    commands = {
        name: command_of(SweepOptions, MethodsCommand, about=about, sweep=name)
        for name, about in _ABOUT.items()
    }
    return one_of(commands)


@dataclass(frozen=True)
class Simulate:
    """Repeat the AEPnP paper's simulation: tables, a page, and figures as PNG and PDF."""

    what: Annotated[Any, tyro.conf.arg(name="", constructor_factory=_commands)]

    def run(self) -> int:
        """Run the simulation that was chosen; returns its exit code."""
        code: int = self.what.run()
        return code
