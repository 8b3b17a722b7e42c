"""Options of the simulation, and its sweeps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import Annotated, Literal, Self

import tyro

from cadalign.errors import InputError
from cadalign.evaluation.options import FunctionOptions


@dataclass(frozen=True)
class SweepKind:
    """The quantity that is varied, a column of the result table, and those that are held."""

    name: str
    column: Literal["noise_px", "points", "outlier_share"]
    values: tuple[int | float, ...]
    points: int
    noise_px: float
    outlier_share: float
    methods: tuple[str, ...]
    runs: int

    @property
    def is_timed(self) -> bool:
        """True where the running time is measured."""
        return self.name == "runtime"


_NOISE = SweepKind(
    name="noise",
    column="noise_px",
    values=(0.5, *(float(noise) for noise in range(1, 11))),
    points=1024,
    noise_px=2.0,
    outlier_share=0.0,
    methods=("optimal", "aepnp", "aepnp-paper", "epnp", "limit"),
    runs=2000,
)
_POINTS = replace(
    _NOISE,
    name="points",
    column="points",
    values=(6, 7, 8, 10, 15, 20, 50, 100, 200, 500, 1024),
)
_OUTLIERS = replace(
    _NOISE,
    name="outliers",
    column="outlier_share",
    values=tuple(round(0.1 * tenth, 1) for tenth in range(8)),
    points=100,
    methods=("ransac-optimal", "ransac-aepnp", "optimal-cauchy", "optimal", "limit"),
    runs=500,
)
_RUNTIME = replace(
    _POINTS,
    name="runtime",
    values=(6, 10, 20, 50, 100, 200, 500, 1024, 2048),
    methods=("optimal", "aepnp", "aepnp-paper", "epnp"),
    runs=100,
)
SWEEPS = {kind.name: kind for kind in (_NOISE, _POINTS, _OUTLIERS, _RUNTIME)}


@dataclass(frozen=True)
class SweepOptions(FunctionOptions):
    """Repeat the AEPnP paper's simulation: a table, a page, and figures as PNG and PDF."""

    experiment = "simulate"
    command = "simulate"

    sweep: Annotated[str, tyro.conf.Suppress]
    """The quantity that is varied: noise, points, outliers or runtime."""
    _: KW_ONLY
    methods: tuple[str, ...] | None = None
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, ransac-optimal, ransac-ap4p,
    ransac-aepnp, and limit: the Cramer-Rao bound. The sweep's own by default."""
    values: tuple[float, ...] | None = None
    """Values of the quantity that is varied, instead of the sweep's own."""
    runs: int | None = None
    """Problems for each value."""
    points: int | None = None
    """Number of points, where it is held."""
    noise_px: float | None = None
    """Standard deviation of the noise in pixels, where it is held."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sweep not in SWEEPS:
            raise InputError(
                f"unknown sweep {self.sweep!r}",
                where="sweep",
                fix=f"known are {', '.join(SWEEPS)}",
            )
        if self.methods is not None:
            from cadalign.evaluation.methods.registry import checked_names

            object.__setattr__(self, "methods", checked_names(self.methods))
        if self.values is not None:
            object.__setattr__(self, "values", tuple(float(value) for value in self.values))
        _check_values(self.kind)

    def with_methods(self, names: tuple[str, ...]) -> Self:
        """The options with further methods beside the sweep's own."""
        return replace(self, methods=(*self.kind.methods, *names))

    @property
    def kind(self) -> SweepKind:
        """The sweep, with what is given in place of its own settings."""
        names = {field.name for field in fields(SweepKind)}
        given = {
            name: value for name, value in vars(self).items() if name in names and value is not None
        }
        return replace(SWEEPS[self.sweep], **given)

    @property
    def run_name(self) -> str:
        """Name of the run's folder, unless another is given."""
        return f"simulate_{self.sweep}"

    @property
    def default_workers(self) -> int:
        """Processes side by side would slow one another down where times are measured."""
        return 1 if self.kind.is_timed else -1


OPTIONS = SweepOptions

# Quantities that may be varied: a check, a name, and values to give.
_CHECKS: dict[str, tuple[Callable[[float], bool], str, str]] = {
    "points": (
        lambda value: value >= 4 and value == int(value),
        "a number of points",
        "give 4 or more",
    ),
    "noise_px": (lambda value: 0 <= value < math.inf, "a noise level", "give pixels, 0 or more"),
    "outlier_share": (lambda value: 0 <= value < 1, "a share", "give 0 to 0.95"),
}


def _check_values(kind: SweepKind) -> None:
    """Check the values of a sweep."""
    if not kind.values:
        raise InputError("none is given", where="values")
    settings = {column: (getattr(kind, column),) for column in _CHECKS}
    for column, values in {**settings, kind.column: kind.values}.items():
        valid, what, fix = _CHECKS[column]
        for value in values:
            if not valid(value):
                where = "values" if column == kind.column else column
                raise InputError(f"{value:g} is not {what}", where=where, fix=fix)
    if kind.runs < 1:
        raise InputError(f"{kind.runs} is not positive", where="runs")
