"""Options that experiments share: each is at once API, command line and run configuration.

Experiments add their own in ``<experiment>/options.py``. The command line takes a field's help from
the text below it. These modules load quickly: `cadalign --help` imports them.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from cadalign.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions:
    """Options of every experiment."""

    experiment: ClassVar[str]
    """Name of the experiment, as the run's configuration has it."""
    command: ClassVar[str] = "evaluate"
    """Command that runs it."""

    seed: int = 0
    """Seed of everything random."""

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

    @property
    def threads(self) -> int:
        """Number of threads of a run without workers."""
        return 1

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
                raise InputError(
                    f"unknown value {value!r}", where=name, fix=f"known are {', '.join(known)}"
                )


@dataclass(frozen=True, kw_only=True)
class ModelOptions(ExperimentOptions):
    """Choice of the models of a dataset."""

    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    max_models: int | None = None
    """Largest number of models of each category."""
    shapenet: Path | None = None
    """Folder of ShapeNetCore, for the meshes, if they are not below the root."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_models=1)

    def as_config(self) -> dict[str, Any]:
        """The options in a run's configuration: ``shapenet`` only where it is given."""
        config = asdict(self)
        shapenet = config.pop("shapenet")
        return config if shapenet is None else {**config, "shapenet": str(shapenet.absolute())}


@dataclass(frozen=True, kw_only=True)
class NoiseOption(ExperimentOptions):
    """Noise of the keypoints."""

    noise_px: float = 1.0
    """Standard deviation of the keypoints' noise, in pixels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.noise_px < math.inf:
            raise InputError(f"{self.noise_px} is not a noise level", where="noise_px")


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Place and workers of a run; its results do not depend on them."""

    out: Path | None = None
    """The run's folder; one in runs/, named after the experiment, by default."""
    workers: int | None = None
    """Processes; -1 for one for each core (the default; for running times it is 1), 0 for none."""
    dask: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""


def tuples(options: dict[str, Any]) -> dict[str, Any]:
    """Make the lists and other iterables among options tuples."""
    plain = (str, bytes, int, float, Path, type(None))
    return {
        name: value if isinstance(value, plain) or not hasattr(value, "__iter__") else tuple(value)
        for name, value in options.items()
    }
