"""The command line: `cadalign <command>`."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from importlib import import_module
from inspect import cleandoc
from operator import or_
from typing import Annotated, Any

import tyro

from cadalign import __version__
from cadalign.cli.common import UsageError
from cadalign.errors import CadalignError
from cadalign.io.files import keeping

_OBJECTS_BETWEEN_COLLECTIONS = 50_000
COMMANDS = {  # the class of each in its module, and the first sentence of its description
    "demo": (
        "evaluate.Demo",
        "Align stretched models to pictures of the originals and show the result.",
    ),
    "fit": ("fit.Fit", "Align a model to what an observation file holds, and draw the result."),
    "observe": ("observe.Observe", "Pair the keypoints of a detector in a photo with a model's."),
    "annotate": (
        "annotate.Annotate",
        "Mark keypoints on photos and a model in the browser, and see the alignment as you go.",
    ),
    "retrieve": (
        "retrieve.Retrieve",
        "Find the models of a library that explain an image's keypoints best.",
    ),
    "library": ("retrieve.LibraryCommand", "Build and inspect libraries of CAD models."),
    "shape": ("shape.ShapeCommand", "Learn and inspect the shapes of categories."),
    "evaluate": ("evaluate.Evaluate", "Evaluate methods on a dataset."),
    "simulate": (
        "evaluate.Simulate",
        "Repeat the AEPnP paper's simulation: tables, a page, and figures as PNG and PDF.",
    ),
    "report": ("evaluate.ReportCommand", "Show the result of one or more runs."),
    "export": ("fit.Export", "Write a fit for another tool."),
    "render": (
        "render.Render",
        "Draw a model: a still, or a contact sheet of several views.",
    ),
    "doctor": (
        "doctor.Doctor",
        "Check the renderers, and show how to enable missing ones.",
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns
    -------
    int
        0 on success, 1 if the input was refused; a wrong command line exits with 2. Runs (evaluate,
        simulate) exit with 3 if they finished with some failed rows.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        sys.stdout.write(f"cadalign {__version__}\n")
        return 0
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    # A start makes a million objects that stay: the search for garbage among them takes 6 % of it.
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS, *gc.get_threshold()[1:])
    try:
        with keeping(()):  # nor write over the models and textures that it reads
            return int(_parse(given).run())
    except UsageError as error:
        sys.stderr.write(f"cadalign: {error}\n")
        raise SystemExit(2) from None
    except CadalignError as error:
        sys.stderr.write(f"cadalign: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("cadalign: interrupted; a run goes on if it is started again\n")
        return 1
    except BrokenPipeError:  # the reader of the output has closed it
        return 0


def class_of(name: str) -> Any:
    """The class of a command; its module is imported when the command is called."""
    module, _, kind = COMMANDS[name][0].partition(".")
    return getattr(import_module(f"cadalign.cli.{module}"), kind)


def _parse(arguments: list[str]) -> Any:
    """The called command with its options; any other line is answered by help or an error."""
    config = (tyro.conf.OmitSubcommandPrefixes,)
    name, *rest = arguments or [""]
    if name in COMMANDS:
        command = class_of(name)
        about = cleandoc(str(command.__doc__))
        prog = f"cadalign {name}"
        return tyro.cli(command, prog=prog, description=about, args=rest, config=config)
    stubs = [
        Annotated[_Listed, tyro.conf.subcommand(name, description=summary)]
        for name, (_, summary) in COMMANDS.items()
    ]
    listed: Any = reduce(or_, stubs)
    return tyro.cli(
        listed,
        prog="cadalign",
        description="Align CAD models to photos from keypoints. --version prints the version. "
        "`cadalign <command> --help` describes a command.",
        args=arguments,
        config=config,
    )


@dataclass(frozen=True)
class _Listed:
    """A command in the list of all, none of which is called."""
