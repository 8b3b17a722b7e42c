"""Options that experiments share: each is at once API, command line and run configuration.

An experiment adds its own in its module. The command line takes a field's help from the text below
it. These modules load quickly: `cadalign evaluate --help` imports them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from copy import copy
from dataclasses import KW_ONLY, dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, cast

import tyro

from cadalign.errors import InputError, unknown

T = TypeVar("T")
Function = str | Callable[..., Any]
"""A function, or the text ``module:function`` by which it is imported."""


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions:
    """Options of every experiment."""

    experiment: ClassVar[str]
    """Name of the experiment, as in the run's configuration."""
    command: ClassVar[str] = "evaluate"
    """Command that runs it."""

    seed: int = 0
    """Seed of the random numbers."""

    def __post_init__(self) -> None:
        self.check_least(seed=0)

    @property
    def run_name(self) -> str:
        """Name of the run's folder, unless another is given."""
        return self.experiment

    @property
    def default_workers(self) -> int:
        """Number of worker processes, unless another is given; see `RunOptions`."""
        return -1

    def as_config(self) -> dict[str, Any]:
        """The options and the experiment's name in a run's configuration, paths made absolute.

        Options of several values have none there if they are empty.
        """
        options = {name: each for name, each in plain_value(self).items() if each != []}
        return {**options, "experiment": self.experiment}

    def check_least(self, **bounds: float) -> None:
        """Check that options, if they are given, are not less than their bounds."""
        for name, least in bounds.items():
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise InputError(f"{value} is less than {least}", where=name)

    def check_known(self, **choices: tuple[str, ...]) -> None:
        """Check that options are among those that are known."""
        for name, known in choices.items():
            value = getattr(self, name)
            if value not in known:
                raise unknown("value", value, known, where=name)

    def check_noise(self, *names: str) -> None:
        """Check that options are standard deviations, which may be 0."""
        for name in names:
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise InputError(f"{value} is not a noise level", where=name)

    def replace_values(self, **values: Any) -> None:
        """Set options of a new instance to their checked values."""
        for name, value in values.items():
            object.__setattr__(self, name, value)


def is_function(given: object) -> bool:
    """True for a callable, and for a text ``module:function``."""
    return callable(given) or (isinstance(given, str) and ":" in given)


def name_of(function: Function) -> str:
    """The name of a function in tables, that of its class for a callable object."""
    if isinstance(function, str):
        return function.rpartition(":")[2].rpartition(".")[2]
    function = _innermost(function)
    return str(getattr(function, "__name__", type(function).__name__))


def text_of(function: Function) -> str:
    """The function as ``module:function``, for a run's configuration."""
    if isinstance(function, str):
        return function
    function = _innermost(function)
    name = getattr(function, "__qualname__", type(function).__qualname__)
    return f"{function.__module__}:{name}"


def _innermost(function: Any) -> Any:
    """The function itself of one whose arguments are bound by functools.partial."""
    while isinstance(function, partial):
        function = function.func
    return function


def plain_value(value: Any) -> Any:
    """The value as JSON has it, paths absolute and normalised, functions by their names."""
    if is_dataclass(value):
        return {each.name: plain_value(getattr(value, each.name)) for each in fields(value)}
    if callable(value):
        return text_of(value)
    if isinstance(value, dict):
        return {name: plain_value(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(each) for each in value]
    if hasattr(value, "tolist"):  # an array
        return value.tolist()
    return os.path.abspath(value) if isinstance(value, Path) else value


@dataclass(frozen=True, kw_only=True)
class FunctionOptions(ExperimentOptions):
    """Options of experiments that take functions of one's own, as methods and as metrics.

    Each is a callable or a text ``module:function``; see `cadalign.evaluation.methods`.
    """

    metrics: tuple[str, ...] = ()
    """Additional metrics of your own, each as module:function."""

    def check_methods(self, own: tuple[str, ...] | None = None) -> None:
        """Check methods, each once; ``own`` are the names of the experiment's, if it has any."""
        from cadalign.evaluation.methods import checked_methods

        self.replace_values(methods=checked_methods(getattr(self, "methods", ()), own))


@dataclass(frozen=True)
class ModelOptions(ExperimentOptions):
    """Choice of the models of a dataset."""

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of a data set in KeypointNet's layout."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to use; all by default."""
    max_models: int | None = None
    """Maximum number of models per category; all by default."""
    shapenet: Path | None = None
    """ShapeNetCore folder with the meshes, if they are not inside PATH."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_models=1)


@dataclass(frozen=True)
class ViewOptions(ModelOptions, FunctionOptions):
    """Views of a dataset's models, with noisy keypoints."""

    _: KW_ONLY
    noise_px: float = 1.0
    """Standard deviation of the keypoint noise [px]."""
    views_per_model: int = 1
    """Number of views per model. Each view is an instance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_noise("noise_px")
        self.check_least(views_per_model=1)

    @property
    def sigma(self) -> float:
        """Standard deviation of the keypoints that methods are given [px]."""
        return self.noise_px or 1.0


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Place and workers of a run; its results do not depend on them."""

    out: Path | None = None
    """Output folder; by default runs/ and the name of the experiment."""
    workers: int | None = None
    """Number of processes: -1 for one per core (the default), 0 to use none."""
    dask: str | None = None
    """Address of a Dask scheduler. Its workers are used instead of local processes."""


def absolute_paths(value: T) -> T:
    """The value with the paths in it absolute, for workers that were started elsewhere."""
    found: Any = value
    if isinstance(value, Path):
        found = value.absolute()
    elif isinstance(value, tuple) and not hasattr(value, "_fields"):
        found = tuple(absolute_paths(each) for each in value)
    elif is_dataclass(value) and not isinstance(value, type):
        found = copy(value)
        for each in fields(value):
            object.__setattr__(found, each.name, absolute_paths(getattr(value, each.name)))
    return cast(T, found)


def tuples(options: dict[str, Any]) -> dict[str, Any]:
    """Make the lists and other iterables among options tuples."""
    return {
        name: value if isinstance(value, str) or not hasattr(value, "__iter__") else tuple(value)
        for name, value in options.items()
    }
