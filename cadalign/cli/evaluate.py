"""`cadalign evaluate`: whole datasets, in runs that can be killed and started again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import tyro

from cadalign.cli.runs import command_of, conclude
from cadalign.errors import DataError

_COMMAND = "evaluate"


@dataclass(frozen=True)
class EvaluateShow:
    """Show a finished run again: its summary, and its figures drawn anew."""

    run_folder: Annotated[Path, tyro.conf.Positional]
    """The run's folder."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Show the run; returns the exit code, that of the run."""
        from cadalign.evaluation.registry import spec_of_config
        from cadalign.evaluation.runs.folder import RunFolder
        from cadalign.evaluation.runs.opened import Run

        folder = RunFolder(self.run_folder)
        config = folder.read_config()
        spec = None if config is None else spec_of_config(config, self.run_folder)
        if spec is None or spec.options.command != _COMMAND:
            raise DataError("not the folder of an evaluation's run", where=str(self.run_folder))
        if not folder.is_finished:
            raise DataError(
                "the run is not finished",
                where=str(self.run_folder),
                fix="start the command that made it again: it goes on",
            )
        return conclude(spec, Run.open(self.run_folder), json=self.json)


def _commands() -> Any:
    """The command of every experiment that `cadalign evaluate` runs, and `show`."""
    from cadalign.evaluation.registry import known_options

    commands: list[Any] = [
        Annotated[command_of(options), tyro.conf.subcommand(options.experiment)]
        for options in known_options()
        if options.command == _COMMAND
    ]
    return reduce(or_, [*commands, Annotated[EvaluateShow, tyro.conf.subcommand("show")]])


@dataclass(frozen=True)
class Evaluate:
    """Evaluate methods on a dataset."""

    what: Annotated[Any, tyro.conf.arg(constructor_factory=_commands)]

    def run(self) -> int:
        """Run the evaluation that was chosen; returns its exit code."""
        code: int = self.what.run()
        return code
