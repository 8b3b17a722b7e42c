"""Registry of experiments: those of this package, by their folders, and those that are registered.

An experiment of your own needs a single file, anywhere: options (`cadalign.evaluation.options`),
tasks and an experiment (`cadalign.evaluation.runs.work`), a specification, and ::

    SPEC = register(Spec(options=MyOptions, plan=plan, columns=COLUMNS, summarize=summarize))

Import that file before the command line runs; its runs, tables, page and `evaluate show` follow.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import DataError, InputError, quote
from cadalign.evaluation.options import ExperimentOptions

if TYPE_CHECKING:
    from cadalign.evaluation.runs.opened import Run
    from cadalign.evaluation.spec import Spec

# The folders of experiments in this package, in the order in which they are named to users.
_FOLDERS = (
    "keypointnet",
    "demo",
    "simulation",
    "correspondences",
    "retrieval",
    "unseen",
    "evidence",
    "photos",
    "estimates",
)
_REGISTERED: dict[str, Spec] = {}


def register(spec: Spec) -> Spec:
    """Make an experiment known; returns its specification."""
    _REGISTERED[spec.name] = spec
    return spec


def known_options() -> Iterator[type[ExperimentOptions]]:
    """The options of all experiments."""
    for folder in _FOLDERS:
        found: type[ExperimentOptions] = import_module(f"{__package__}.{folder}.options").OPTIONS
        yield found
    yield from (spec.options for spec in _REGISTERED.values())


def spec_named(name: str) -> Spec:
    """The specification of an experiment."""
    if name in _REGISTERED:
        return _REGISTERED[name]
    for folder in _FOLDERS:
        if import_module(f"{__package__}.{folder}.options").OPTIONS.experiment == name:
            spec: Spec = import_module(f"{__package__}.{folder}.spec").SPEC
            return spec
    names = [options.experiment for options in known_options()]
    what, fix = f"unknown experiment {quote(name)}", f"known are {', '.join(names)}"
    raise InputError(what, where="experiment", fix=fix)


def spec_of(run: Run) -> Spec:
    """The specification of a run's experiment."""
    return spec_of_config(run.config, run.folder.path)


def spec_of_config(config: dict[str, Any], path: Path) -> Spec:
    """The specification of the experiment that a run's configuration names; see `spec_of`."""
    name = config.get("experiment")
    try:
        return spec_named(str(name))
    except InputError as error:
        raise DataError(
            f"there is no report on a run of {quote(name)}", where=str(path), fix=error.fix
        ) from None
