"""The command line: `cadalign <command>`."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from cadalign.cli.annotate import Annotate
from cadalign.cli.demo import Demo
from cadalign.cli.doctor import Doctor
from cadalign.cli.evaluate import Evaluate
from cadalign.cli.fit import Fit
from cadalign.cli.library import LibraryCommand
from cadalign.cli.observe import Observe
from cadalign.cli.render import Render
from cadalign.cli.report import Report
from cadalign.cli.retrieve import Retrieve
from cadalign.cli.shape import ShapeCommand
from cadalign.cli.simulate import Simulate
from cadalign.errors import CadalignError

Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Observe, tyro.conf.subcommand("observe")]
    | Annotated[Annotate, tyro.conf.subcommand("annotate")]
    | Annotated[Retrieve, tyro.conf.subcommand("retrieve")]
    | Annotated[LibraryCommand, tyro.conf.subcommand("library")]
    | Annotated[ShapeCommand, tyro.conf.subcommand("shape")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns
    -------
    int
        0 on success, 1 if the input was refused; a wrong command line exits with 2. Runs (evaluate,
        simulate) exit with 3 if they finished with some failed rows.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        command = tyro.cli(
            Command,
            prog="cadalign",
            description="Align CAD models to photos from keypoints.",
            args=arguments,
            config=(tyro.conf.OmitSubcommandPrefixes,),
        )
        return command.run()
    except CadalignError as error:
        sys.stderr.write(f"cadalign: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("cadalign: interrupted; a run goes on if it is started again\n")
        return 1
    except BrokenPipeError:  # the reader of the output has closed it
        return 0
