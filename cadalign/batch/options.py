"""Options of a run over many observations."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cadalign.estimation.observation_fit import ObservationFit
from cadalign.evaluation.options import ExperimentOptions
from cadalign.io.input_kinds import DetectorOptions
from cadalign.io.observation import ObservationChanges


@dataclass(frozen=True, kw_only=True)
class FitRunOptions(ExperimentOptions):
    """A run that aligns many observations.

    Parameters
    ----------
    inputs : tuple of Path
        Observation files, folders and patterns of such, JSON lines, files of detectors.
    estimate : ObservationFit
    changes : ObservationChanges
        What takes the place of the observations' own.
    detector : DetectorOptions
    pictures : int
        Number of observations whose photos the page shows, the first ones.
    """

    experiment: ClassVar[str] = "fit"
    command: ClassVar[str] = "fit"

    inputs: tuple[Path, ...]
    estimate: ObservationFit = field(default_factory=ObservationFit)
    changes: ObservationChanges = field(default_factory=ObservationChanges)
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    pictures: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(pictures=0)

    def as_config(self) -> dict[str, Any]:
        """The options in a run's configuration, without those that are at their defaults."""
        given = asdict(self)
        usual = asdict(FitRunOptions(inputs=()))
        parts = {name: given.pop(name) for name in ("estimate", "changes", "detector")}
        for name, part in parts.items():
            given |= {key: value for key, value in part.items() if value != usual[name][key]}
        return {name: _plain(value) for name, value in given.items()}


def _plain(value: Any) -> Any:
    """A value for JSON."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return str(value.absolute()) if isinstance(value, Path) else value
