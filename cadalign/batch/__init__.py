"""Alignment of many observations as a run."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.batch.observation_fit import ObservationFit
    from cadalign.batch.retrievals import RetrieveRunOptions
    from cadalign.batch.runs import FitRunOptions, fit_many, run_many
    from cadalign.io.observation import DetectorOptions, ObservationChanges

__all__ = [
    "DetectorOptions",
    "FitRunOptions",
    "ObservationChanges",
    "ObservationFit",
    "RetrieveRunOptions",
    "fit_many",
    "run_many",
]

__getattr__ = lazy_names(__name__)
