"""The command line: `cadalign <command>`."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import reduce
from importlib import import_module
from inspect import cleandoc
from operator import or_
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from cadalign import __version__
from cadalign.cli.common import UsageError
from cadalign.errors import CadalignError
from cadalign.io.files import protect_inputs

_OBJECTS_BETWEEN_COLLECTIONS = 50_000
COMMANDS = {  # module and class, and the first sentence of the help
    "demo": (
        "evaluate.Demo",
        "Align stretched models to pictures of the originals and show the results.",
    ),
    "fit": ("fit.Fit", "Align a model to an observation, and draw the result."),
    "observe": ("observe.Observe", "Match a detector's keypoints to a model's keypoints."),
    "annotate": (
        "annotate.Annotate",
        "Mark keypoints on photos and a model in the browser, with a live alignment.",
    ),
    "retrieve": (
        "retrieve.Retrieve",
        "Find the models of a library that best explain an image's keypoints.",
    ),
    "library": ("retrieve.LibraryCommand", "Build and inspect libraries of CAD models."),
    "shape": ("shape.ShapeCommand", "Learn, list and inspect shape models of categories."),
    "evaluate": ("evaluate.Evaluate", "Evaluate methods on a dataset."),
    "simulate": (
        "evaluate.Simulate",
        "Repeat the AEPnP paper's simulation.",
    ),
    "report": ("evaluate.ReportCommand", "Write a page with the results of one or more runs."),
    "export": ("fit.Export", "Write a fit for another tool."),
    "render": (
        "render.Render",
        "Draw a model: one view, or a contact sheet of several views.",
    ),
    "doctor": (
        "doctor.Doctor",
        "Check the renderers, and show how to enable those that fail.",
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns
    -------
    int
        0 on success, 1 if the input was refused, 2 for a wrong command line, 3 if some rows of a
        run failed.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        sys.stdout.write(f"cadalign {__version__}\n")
        return 0
    handler = logging.StreamHandler()
    handler.addFilter(drop_repeats())
    logging.basicConfig(format="%(levelname)s: %(message)s", handlers=[handler])
    # Imports create a million permanent objects. Rarer collections save 6 % of a start.
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS, *gc.get_threshold()[1:])
    try:
        with protect_inputs(()):  # models and textures that are read are not overwritten
            return int(_parse(given).run())
    except UsageError as error:
        sys.stderr.write(f"cadalign: {error}\n")
        raise SystemExit(2) from None
    except CadalignError as error:
        sys.stderr.write(f"cadalign: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("cadalign: interrupted; start a run again to continue it\n")
        return 1
    except BrokenPipeError:  # the reader of the output has closed it
        return 0


def drop_repeats() -> Callable[[logging.LogRecord], bool]:
    """Make a filter that passes each text once: commands read some files several times."""
    texts = set[str]()

    def is_new(record: logging.LogRecord) -> bool:
        before = len(texts)
        texts.add(record.getMessage())
        return len(texts) > before

    return is_new


def class_of(name: str) -> Any:
    """Import the class of a command."""
    module, _, kind = COMMANDS[name][0].partition(".")
    return getattr(import_module(f"cadalign.cli.{module}"), kind)


def _parse(arguments: list[str]) -> Any:
    """Parse the command line; help and errors exit."""
    config = (tyro.conf.OmitSubcommandPrefixes,)
    name, *rest = arguments or [""]
    if name in COMMANDS:
        command = class_of(name)
        about = cleandoc(str(command.__doc__))
        prog = f"cadalign {name}"
        rules = _help_rules()
        return tyro.cli(
            command, prog=prog, description=about, args=rest, config=config, registry=rules
        )
    stubs = [
        Annotated[_CommandStub, tyro.conf.subcommand(name, description=summary)]
        for name, (_, summary) in COMMANDS.items()
    ]
    listed: Any = reduce(or_, stubs)
    return tyro.cli(
        listed,
        prog="cadalign",
        description="Align CAD models to photos from keypoints. "
        "`cadalign <command> --help` describes a command. `cadalign --version` prints the version.",
        args=arguments,
        config=config,
    )


def _help_rules() -> ConstructorRegistry:
    """Make rules that join the lines of options' help and omit hints such as (default: None)."""
    registry, inner = ConstructorRegistry(), False

    @registry.struct_rule
    def describe(info: StructTypeInfo) -> StructConstructorSpec | None:
        nonlocal inner
        if inner or not is_dataclass(info.type):
            return None
        inner = True  # tyro's own rule, not this one
        spec: Any = ConstructorRegistry.get_struct_spec(info)
        inner = False
        found: StructConstructorSpec = replace(spec, fields=tuple(map(_describe, spec.fields)))
        return found

    return registry


def _describe(field: StructFieldSpec) -> StructFieldSpec:
    def help_of(text: Any = field.helptext) -> str | None:
        text = text() if callable(text) else text
        return text and " ".join(text.split())

    kind: Any = field.type
    if field.default is None or field.default is False or field.default == ():
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return replace(field, helptext=help_of, type=kind)


@dataclass(frozen=True)
class _CommandStub:
    """A command in the list that `cadalign --help` prints."""
