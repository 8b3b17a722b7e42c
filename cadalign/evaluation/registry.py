"""Registry of experiments: the modules of `cadalign.evaluation.experiments`, and those of users.

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

from cadalign.errors import DataError, InputError, quote, unknown
from cadalign.evaluation.options import ExperimentOptions

if TYPE_CHECKING:
    from cadalign.evaluation.runs.opened import Run
    from cadalign.evaluation.spec import Spec

# In the order in which they are named to users.
_MODULES = (
    "keypointnet",
    "demo",
    "simulation",
    "correspondences",
    "retrieval",
    "unseen",
    "evidence",
    "photos",
    "estimates",
    "tracks",
)
_REGISTERED: dict[str, Spec] = {}


def register(spec: Spec) -> Spec:
    """Make an experiment known; returns its specification."""
    _REGISTERED[spec.name] = spec
    return spec


def known_specs() -> Iterator[Spec]:
    """The specifications of all experiments."""
    for name in _MODULES:
        spec: Spec = import_module(f"cadalign.evaluation.experiments.{name}").SPEC
        yield spec
    yield from _REGISTERED.values()


def known_options() -> Iterator[type[ExperimentOptions]]:
    """The options of all experiments."""
    return (spec.options for spec in known_specs())


def spec_named(name: str) -> Spec:
    """The specification of an experiment."""
    if name in _REGISTERED:
        return _REGISTERED[name]
    known = []
    for spec in known_specs():
        if spec.name == name:
            return spec
        known.append(spec.name)
    raise unknown("experiment", name, known)


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
