"""Options of the retrieval experiment."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.errors import InputError
from cadalign.evaluation.options import ModelOptions

LEAVE_IN = "leave-in"
"""The library holds the true model."""
LEAVE_OUT = "leave-out"
"""It doesn't."""
PROTOCOLS = (LEAVE_IN, LEAVE_OUT)
METHODS = ("optimal", "optimal-unstretched", "epnp")


@dataclass(frozen=True)
class RetrievalRunOptions(ModelOptions):
    """Evaluate the retrieval of CAD models.

    Each model is stretched by factors from 0.5 to 2 along y and z and seen from a random view; some
    of its visible keypoints, with noise, are looked up in a library that holds the model
    (leave-in), and in one that doesn't (leave-out). The run's folder gets results.parquet with a
    row per query, protocol and method, summary.csv, figures and the library. Killed, it goes on
    where it was when the same command is started again.
    """

    experiment = "retrieval"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout, or a library's file."""
    _: KW_ONLY
    noises_px: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Standard deviations of the keypoints' noise, in pixels."""
    keypoints: tuple[int, ...] = (6, 7, 8, 9, 10)
    """Numbers of visible keypoints that are given."""
    protocols: tuple[str, ...] = PROTOCOLS
    """leave-in, leave-out."""
    methods: tuple[str, ...] = ("optimal", "epnp")
    """optimal, optimal-unstretched, epnp."""
    whole_library: bool = False
    """Compare with the models of all categories, not only with those of the right one."""
    shape_sigma: float = 0.02
    """Standard deviation of the keypoints of the best model where the library lacks the right one,
    as a share of their extent."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, known in (("methods", METHODS), ("protocols", PROTOCOLS)):
            chosen = tuple(dict.fromkeys(getattr(self, name)))
            object.__setattr__(self, name, chosen)
            unknown = [value for value in chosen if value not in known]
            if unknown or not chosen:
                what = f"unknown: {unknown[0]!r}" if unknown else "none is given"
                raise InputError(what, where=name, fix=f"known are {', '.join(known)}")
        for name, least in (("noises_px", 0), ("keypoints", 4)):
            values = tuple(sorted(set(getattr(self, name))))
            object.__setattr__(self, name, values)
            if not values:
                raise InputError("none is given", where=name)
            if not least <= values[0] or not values[-1] < math.inf:
                raise InputError(f"{values[0]:g} is less than {least}", where=name)
        self.check_least(shape_sigma=0)


OPTIONS = RetrievalRunOptions
