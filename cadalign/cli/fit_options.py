"""Options of `cadalign fit` about the estimate."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import tyro

from cadalign.cli.options import ObservationCommand, OptionError, flag_of, named_as_flags
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.observation_fit import ObservationFit
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma


@dataclass(frozen=True)
class _FitOptions(FitOptions):
    """Method and model; the observation file supplies the other options."""

    sigma: tyro.conf.Suppress[Sigma | None] = FitOptions.sigma
    focal: tyro.conf.Suppress[str] = FitOptions.focal
    focal_prior: tyro.conf.Suppress[FocalPrior | None] = FitOptions.focal_prior

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True)
class _RansacOptions(RansacOptions):
    """Search for outliers (LO-RANSAC), with --robust."""

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class EstimateOptions(ObservationFit, ObservationCommand):
    """Model, noise, focal length and robust search of a fit."""

    # A group's own text: without it, tyro reads the documentation of all options for every fit.
    fitting: Annotated[
        _FitOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_FitOptions.__doc__)
    ] = _FitOptions()
    ransac: Annotated[
        _RansacOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_RansacOptions.__doc__)
    ] = _RansacOptions()

    named = staticmethod(flag_of)

    @property
    def estimate(self) -> ObservationFit:
        """The options of the estimate alone, without those of the command."""
        given = {field.name: getattr(self, field.name) for field in fields(ObservationFit)}
        given["fitting"] = FitOptions(**vars(self.fitting))
        given["ransac"] = RansacOptions(**vars(self.ransac))
        return ObservationFit(**given)
