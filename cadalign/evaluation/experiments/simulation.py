"""The AEPnP paper's simulation: errors of methods while one quantity varies.

640 x 480 px, f = 150 px, points in [-1, 1)^3, true scales in [0.5, 2]; see
`cadalign.evaluation.simulation.simulate_problem`. A summary covers the problems that a method
solved at one value of the varied quantity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import tyro

from cadalign.arrays import instance_rng
from cadalign.errors import DataError, InputError, quote, unknown_name
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import Benchmark, Case, Setting
from cadalign.evaluation.methods import Method, MethodInput, pose_of
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.options import FunctionOptions, plain_value
from cadalign.evaluation.plots import Plot, plot_against
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Plan, Row
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.evaluation.summary import Summary, group_name, medians, summarize
from cadalign.geometry.alignment import Alignment

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run


@dataclass(frozen=True)
class SweepKind:
    """A sweep: the varied quantity (a column of the result table) and the constant ones."""

    name: str
    column: Literal["noise_px", "points", "outlier_share"]
    values: tuple[int | float, ...]
    points: int
    noise_px: float
    outlier_share: float
    methods: tuple[str, ...]
    runs: int


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
    _NOISE, name="points", column="points", values=(6, 7, 8, 10, 15, 20, 50, 100, 200, 500, 1024)
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
SWEEPS = {kind.name: kind for kind in (_NOISE, _POINTS, _OUTLIERS)}


@dataclass(frozen=True)
class SweepOptions(FunctionOptions):
    """Repeat the AEPnP paper's simulation.

    Random problems are solved while one quantity varies. The run's folder gets results.parquet,
    summary.csv, report.html, and figures as PNG and PDF.
    """

    experiment = "simulate"
    command = "simulate"

    sweep: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SWEEP")]
    """The varied quantity: noise (with 1,024 points); points (with 2 px of noise); outliers (with
    100 points and 2 px of noise)."""
    _: KW_ONLY
    methods: tuple[str, ...] | None = None
    """Methods of `cadalign fit`; optimal-huber, optimal-cauchy (robust losses); ransac-optimal,
    ransac-ap4p, ransac-aepnp, ransac-aepnp-refined (RANSAC); limit (the Cramer-Rao bound); or
    functions, as module:function. The default depends on the sweep."""
    values: tuple[float, ...] | None = None
    """Values of the varied quantity, instead of the default ones."""
    runs: int | None = None
    """Number of problems per value; by default 2000 for noise and points, 500 for outliers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sweep not in SWEEPS:
            raise unknown_name("sweep", self.sweep, SWEEPS)
        if self.methods is not None:
            self.check_methods()
        if self.values is not None:
            self.replace_values(values=tuple(float(value) for value in self.values))
        self.check_least(runs=1)
        _check_values(self.kind)

    @property
    def kind(self) -> SweepKind:
        """The sweep with the given options in place of its defaults."""
        given = {name: getattr(self, name) for name in ("methods", "values", "runs")}
        given = {name: value for name, value in given.items() if value is not None}
        return replace(SWEEPS[self.sweep], **given)

    @property
    def run_name(self) -> str:
        """Default name of the run's folder."""
        return f"simulate_{self.sweep}"


# By quantity: minimum, upper bound (excluded), noun, and advice.
_RANGES = {
    "points": (4, math.inf, "a number of points", "give 4 or more"),
    "noise_px": (0, math.inf, "a noise level", "give pixels, 0 or more"),
    "outlier_share": (0, 1, "a share", "give 0 to 0.95"),
}


def _check_values(kind: SweepKind) -> None:
    if not kind.values:
        raise InputError("none is given", where="values")
    least, bound, what, fix = _RANGES[kind.column]
    for value in kind.values:
        if not least <= value < bound or (kind.column == "points" and value != int(value)):
            raise InputError(f"{value:g} is not {what}", where="values", fix=fix)


ERRORS = (metrics.ROTATION, metrics.TRANSLATION_IN_UNITS, metrics.SCALE_Y, metrics.SCALE_Z)
COLUMNS: Columns = (
    *(("points", int), ("noise_px", float), ("outlier_share", float), ("run", int)),
    *(("method", str), ("status", str), ("reason", str)),
    *((metric.key, float) for metric in ERRORS),
)


class SweepTask(NamedTuple):
    """One random problem: its settings and number; ``value`` is of the varied quantity."""

    value: float
    points: int
    noise_px: float
    outlier_share: float
    run: int

    @property
    def names(self) -> Row:
        """The cells that identify its rows, without the method."""
        return {name: value for name, value in self._asdict().items() if name != "value"}


def sweep_tasks(kind: SweepKind) -> list[SweepTask]:
    """All problems of a sweep, value by value."""
    held = {name: getattr(kind, name) for name in ("points", "noise_px", "outlier_share")}
    settings = ({**held, kind.column: value, "value": value} for value in kind.values)
    return [
        SweepTask(**{**setting, "points": int(setting["points"])}, run=run)
        for setting in settings
        for run in range(kind.runs)
    ]


@dataclass(frozen=True)
class SweepProblems(Setting):
    """Instances of the simulation: random problems."""

    columns = COLUMNS

    sweep: str
    seed: int

    def case(self, task: SweepTask) -> Case:
        problem = self.problem(task)
        return Case(task.names, instance=MethodInput.from_problem(problem, task.noise_px or 1.0))

    def row(self, method: Method, given: MethodInput, estimate: Alignment | Result) -> Row:
        assert given.gt is not None
        return {**alignment_errors(est=pose_of(estimate), gt=given.gt)}

    def problem(self, task: SweepTask) -> SimulatedProblem:
        """The problem of a task."""
        rng = instance_rng(self.seed, self.sweep, repr(float(task.value)), str(task.run))
        noise_px, outlier_share = task.noise_px, task.outlier_share
        return simulate_problem(
            rng, points=task.points, noise_px=noise_px, outlier_share=outlier_share
        )


def sweep_benchmark(kind: SweepKind, seed: int, metrics: Sequence[str] = ()) -> Benchmark:
    """The benchmark of a sweep, whose methods solve problems in batches."""
    setting, batched = SweepProblems(kind.name, seed), frozenset(kind.methods)
    return Benchmark.from_methods(setting, kind.methods, metrics=metrics, batched=batched)


def sweep_of(run: Run) -> SweepKind:
    """The sweep of a run, with default settings."""
    name = str(run.config.get("sweep"))
    if name not in SWEEPS:
        where = f"{run.folder.config_file}: sweep"
        raise DataError(f"{quote(name)} is not one of {', '.join(SWEEPS)}", where=where)
    return SWEEPS[name]


def varied_quantity(run: Run) -> Metric:
    """The varied quantity of a run."""
    known = {each.key: each for each in (metrics.NOISE, metrics.POINTS, metrics.OUTLIER_SHARE)}
    return known[sweep_of(run).column]


def summarize_sweep(run: Run) -> list[Summary]:
    """Medians of every metric per value and method, over the solved problems."""
    name = partial(group_name, varied_quantity(run))
    return summarize(run, medians(*ERRORS), by=(sweep_of(run).column,), name=name)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Plots of errors against the varied quantity."""
    x, found = varied_quantity(runs[0]), [summarize_sweep(run) for run in runs]
    return [
        plot_against(found, x, metric, place=x.key, note="medians")
        for metric in (*ERRORS, *runs[0].metrics)
    ]


_CHUNK = 64


def plan(options: SweepOptions, folder: RunFolder) -> Plan[SweepTask]:
    """Plan a sweep."""
    kind = options.kind
    benchmark = sweep_benchmark(kind, options.seed, options.metrics)
    return benchmark.plan(options, sweep_tasks(kind), chunk=_CHUNK, **plain_value(kind))


SPEC = Spec(
    options=SweepOptions,
    plan=plan,
    columns=(metrics.INSTANCES, metrics.FAILED, *ERRORS),
    results=COLUMNS,
    summarize=summarize_sweep,
    group=varied_quantity,
    plots=plots,
    kind=lambda run: f"simulation of {sweep_of(run).name}",
    subject="problems of the AEPnP paper's simulation",
    note="Medians over the problems that did not fail.",
)
