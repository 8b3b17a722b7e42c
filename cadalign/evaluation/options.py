"""Options that experiments share: keywords of the API, command line and run configuration.

An experiment adds its own options in its module. The docstring below a field is its help on the
command line. These modules must load quickly: `cadalign evaluate --help` imports them.
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

from cadalign.errors import InputError, unknown_name
from cadalign.io.pretrained import category_of

T = TypeVar("T")
Function = str | Callable[..., Any]
"""A function, or its import path ``module:function``."""


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions:
    """Options of every experiment."""

    experiment: ClassVar[str]
    """Name of the experiment in the run's configuration."""
    command: ClassVar[str] = "evaluate"
    """Command that runs the experiment."""

    seed: int = 0
    """Seed of the random number generator."""

    def __post_init__(self) -> None:
        self.check_least(seed=0)

    @property
    def run_name(self) -> str:
        """Default name of the run's folder."""
        return self.experiment

    @property
    def default_workers(self) -> int:
        """Default number of worker processes; see `RunOptions`."""
        return -1

    def as_config(self) -> dict[str, Any]:
        """The run's configuration: options with absolute paths, and the experiment's name.

        Empty sequences are left out.
        """
        options = {name: each for name, each in plain_value(self).items() if each != []}
        return {**options, "experiment": self.experiment}

    def check_least(self, **bounds: float) -> None:
        """Raise InputError for options below their bounds; None is allowed."""
        for name, least in bounds.items():
            value = getattr(self, name)
            if value is not None and not value >= least:
                raise InputError(f"{value} is less than {least}", where=name)

    def check_known(self, **choices: tuple[str, ...]) -> None:
        """Raise InputError for options that are not among their choices."""
        for name, known in choices.items():
            value = getattr(self, name)
            if value not in known:
                raise unknown_name("value", value, known, where=name)

    def replace_values(self, **values: Any) -> None:
        """Replace options of a new, still unshared instance."""
        for name, value in values.items():
            object.__setattr__(self, name, value)


def is_function(given: object) -> bool:
    """True for a callable or an import path ``module:function``."""
    return callable(given) or (isinstance(given, str) and ":" in given)


def name_of(function: Function) -> str:
    """The name of a function in tables; for a callable object, its class's name."""
    if isinstance(function, str):
        return function.rpartition(":")[2].rpartition(".")[2]
    function = _unwrap_partial(function)
    return str(getattr(function, "__name__", type(function).__name__))


def text_of(function: Function) -> str:
    """The import path ``module:function`` of a function, for a run's configuration."""
    if isinstance(function, str):
        return function
    function = _unwrap_partial(function)
    name = getattr(function, "__qualname__", type(function).__qualname__)
    return f"{function.__module__}:{name}"


def _unwrap_partial(function: Any) -> Any:
    """The function inside nested functools.partial objects."""
    while isinstance(function, partial):
        function = function.func
    return function


def plain_value(value: Any) -> Any:
    """Convert a value for JSON.

    Paths are absolute and normalised, shapes that come with the package are named by their
    category, and functions by their import paths.
    """
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
    if isinstance(value, Path):
        return category_of(value) or os.path.abspath(value)
    return value


@dataclass(frozen=True, kw_only=True)
class FunctionOptions(ExperimentOptions):
    """Options of experiments that accept user functions as methods and metrics.

    Each is a callable or an import path ``module:function``; see `cadalign.evaluation.methods`.
    """

    metrics: tuple[str, ...] = ()
    """Your own metrics, in addition to the experiment's: module:function."""

    def check_methods(self, own: tuple[str, ...] | None = None) -> None:
        """Check methods and drop repeated ones; ``own`` are the experiment's method names."""
        from cadalign.evaluation.methods import validate_methods

        self.replace_values(methods=validate_methods(getattr(self, "methods", ()), own))


@dataclass(frozen=True)
class ModelOptions(ExperimentOptions):
    """Selection of a dataset's models, and the noise of their keypoints."""

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of a data set in KeypointNet's layout."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to use; all by default."""
    max_models: int | None = None
    """Maximum number of models per category; all by default."""
    shapenet: Path | None = None
    """Folder of ShapeNetCore, if the meshes are not inside the dataset's folder."""
    noise_px: float = 1.0
    """Standard deviation of the keypoint noise [px]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_models=1)
        if not 0 <= self.noise_px < math.inf:
            raise InputError(f"{self.noise_px} is not a noise level", where="noise_px")


@dataclass(frozen=True)
class ViewOptions(ModelOptions, FunctionOptions):
    """Views of a dataset's models, with noisy keypoints."""

    _: KW_ONLY
    views_per_model: int = 1
    """Number of views per model; each view is one instance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(views_per_model=1)

    @property
    def sigma(self) -> float:
        """Standard deviation of the keypoints [px] as methods get it; 1 without noise."""
        return self.noise_px or 1.0


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Folder and workers of a run; the results do not depend on them."""

    out: Path | None = None
    """Folder of the run; by default runs/ and the experiment's name."""
    workers: int | None = None
    """Number of worker processes; -1 for one per core (the default), 0 for this process alone."""
    dask: str | None = None
    """Address of a Dask scheduler; its workers replace the processes."""


def absolute_paths(value: T) -> T:
    """Make all paths in a value absolute, for workers with another working directory."""
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


def as_tuples(options: dict[str, Any]) -> dict[str, Any]:
    """Convert iterables among options to tuples, except for strings."""
    return {
        name: value if isinstance(value, str) or not hasattr(value, "__iter__") else tuple(value)
        for name, value in options.items()
    }
