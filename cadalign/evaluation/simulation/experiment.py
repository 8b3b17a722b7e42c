"""The AEPnP paper's simulation: errors of methods while one thing is varied.

640 x 480 px, f = 150 px, points in [-1, 1)^3, true scales in [0.5, 2]; see
`cadalign.evaluation.simulation.problems.simulate_problem`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cadalign.estimation.result import Result
from cadalign.evaluation.benchmark import Benchmark, Case, Pair, Setting
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.methods.registry import choose_methods
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.metrics.registry import Compared, choose_metrics
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.simulation.options import SweepKind
from cadalign.evaluation.simulation.problems import Problem, simulate_problem
from cadalign.geometry.alignment import Alignment
from cadalign.seeding import instance_rng

_REPEATS = 5
ERRORS = (metrics.ROTATION, metrics.TRANSLATION_IN_UNITS, metrics.SCALE_Y, metrics.SCALE_Z)
COLUMNS: Columns = (
    *(("points", int), ("noise_px", float), ("outlier_share", float), ("run", int)),
    *(("method", str), ("status", str), ("reason", str)),
    *((metric.key, float) for metric in ERRORS),
)


@dataclass(frozen=True)
class SweepTask:
    """One random problem; ``value`` is that of the quantity that is varied."""

    value: float
    run: int


def sweep_tasks(kind: SweepKind) -> list[SweepTask]:
    """All problems of a sweep, value by value."""
    return [SweepTask(value, run) for value in kind.values for run in range(kind.runs)]


@dataclass(frozen=True)
class SweepProblems(Setting):
    """Random problems: the setting of the simulation."""

    columns = COLUMNS
    # Seconds of one call where time is what is measured, a share of the batch's elsewhere.
    names = (("points", int), ("run", int), ("method", str))

    kind: SweepKind
    seed: int

    def warm_up(self) -> Sequence[SweepTask]:
        """A task whose evaluation compiles the solvers."""
        return [SweepTask(self.kind.values[0], 0)]

    def cases(self, tasks: Sequence[SweepTask]) -> list[Case]:
        """The problem of every task."""
        return [Case(self._names(task), instance=self._told(task)) for task in tasks]

    def failed(self, task: SweepTask) -> list[Case]:
        """The case of a task without a problem."""
        return [Case(self._names(task))]

    def given(self, instance: tuple[Problem, float]) -> MethodInput:
        """The points of the problem: methods are told the standard deviation of the noise."""
        problem, sigma = instance
        inliers = None if problem.outliers is None else ~problem.outliers
        return MethodInput(
            problem.points_3d,
            problem.points_2d,
            problem.camera,
            sigma,
            gt=problem.alignment,
            inliers=inliers,
        )

    def answered(
        self, method: Method, instance: tuple[Problem, float], answer: Alignment | Result
    ) -> Alignment:
        """The alignment."""
        return answer if isinstance(answer, Alignment) else answer.alignment

    def compared(self, instance: tuple[Problem, float], estimate: Alignment) -> Compared:
        """The estimated and the true alignment."""
        return Compared(estimate, instance[0].alignment)

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Errors of pose and stretch."""
        return [alignment_errors(est=est, gt=problem.alignment) for (problem, _), est in pairs]

    def problem(self, task: SweepTask) -> Problem:
        """The problem of a task."""
        rng = instance_rng(self.seed, self.kind.name, repr(float(task.value)), str(task.run))
        return simulate_problem(rng, **self._setting(task))

    def _told(self, task: SweepTask) -> tuple[Problem, float]:
        return self.problem(task), self._setting(task)["noise_px"] or 1.0

    def _setting(self, task: SweepTask) -> Row:
        """Points, noise and outliers of a task."""
        held = {name: getattr(self.kind, name) for name in ("points", "noise_px", "outlier_share")}
        setting = {**held, self.kind.column: task.value}
        return {**setting, "points": int(setting["points"])}

    def _names(self, task: SweepTask) -> Row:
        return {**self._setting(task), "run": task.run}


def sweep_benchmark(kind: SweepKind, seed: int, metrics: Sequence[str] = ()) -> Benchmark:
    """The methods of a sweep on its problems: in batches, or timed alone and several times."""
    methods = choose_methods(kind.methods)
    setting, further = SweepProblems(kind, seed), choose_metrics(metrics, COLUMNS)
    if kind.is_timed:
        return Benchmark(setting, methods, repeats=_REPEATS, metrics=further)
    batched = frozenset(each.name for each in methods)
    return Benchmark(setting, methods, batched, metrics=further)
