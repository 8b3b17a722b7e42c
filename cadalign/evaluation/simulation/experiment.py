"""The AEPnP paper's simulation: errors of methods while one thing is varied.

640 x 480 px, f = 150 px, points in [-1, 1)^3, true scales in [0.5, 2]; see
`cadalign.evaluation.simulation.problems.simulate_problem`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from cadalign.errors import CadalignError
from cadalign.estimation.fit import fit, fit_batch
from cadalign.evaluation import metrics
from cadalign.evaluation.accuracy.cramer_rao import limit_estimate
from cadalign.evaluation.accuracy.methods import LIMIT, fit_options
from cadalign.evaluation.outcome import Outcome, alignment_errors
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import Rows
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
class SweepExperiment:
    """Evaluates methods on random problems."""

    columns = COLUMNS
    # Seconds of one call where time is what is measured, a share of the batch's elsewhere.
    timing_columns = (*(("points", int), ("run", int), ("method", str), ("seconds", float)),)

    kind: SweepKind
    seed: int

    def warm_up(self) -> None:
        """Compile the solvers."""
        self.evaluate([SweepTask(self.kind.values[0], 0)])

    def evaluate(self, tasks: Sequence[SweepTask]) -> Rows:
        """A row for every task and method."""
        return Rows.of(
            outcome
            for _, some in groupby(tasks, lambda task: task.value)
            for outcome in self._evaluate_same(list(some))
        )

    def failure(self, task: SweepTask, reason: str) -> Rows:
        """A failed row for every method."""
        return Rows.of(
            Outcome.failure(reason, self._names(task, method)) for method in self.kind.methods
        )

    def problem(self, task: SweepTask) -> Problem:
        """The problem of a task."""
        rng = instance_rng(self.seed, self.kind.name, repr(float(task.value)), str(task.run))
        return simulate_problem(rng, **self._setting(task))

    def _evaluate_same(self, tasks: Sequence[SweepTask]) -> list[Outcome]:
        """Outcomes of tasks of one value: methods are told the standard deviation of the noise."""
        problems = [self.problem(task) for task in tasks]
        sigma = self._setting(tasks[0])["noise_px"] or 1.0
        per_method = [self._run(method, tasks, problems, sigma) for method in self.kind.methods]
        return [outcome for outcomes in zip(*per_method, strict=True) for outcome in outcomes]

    def _setting(self, task: SweepTask) -> Row:
        """Points, noise and outliers of a task."""
        held = {name: getattr(self.kind, name) for name in ("points", "noise_px", "outlier_share")}
        setting = {**held, self.kind.column: task.value}
        return {**setting, "points": int(setting["points"])}

    def _run(
        self, method: str, tasks: Sequence[SweepTask], problems: Sequence[Problem], sigma: float
    ) -> list[Outcome]:
        """One method's outcome of every task."""
        if self.kind.is_timed:
            timed = [_timed(method, problem, sigma) for problem in problems]
        else:
            start = time.perf_counter()
            estimates = _estimates(method, problems, sigma)
            share = (time.perf_counter() - start) / len(problems)
            timed = [(estimate, share) for estimate in estimates]
        outcomes = []
        for task, problem, (est, seconds) in zip(tasks, problems, timed, strict=True):
            names = self._names(task, method)
            if isinstance(est, CadalignError):
                outcome = Outcome.failure(str(est), names)
            else:
                outcome = Outcome(names, alignment_errors(est=est, gt=problem.alignment))
            outcomes.append(replace(outcome, seconds=seconds))
        return outcomes

    def _names(self, task: SweepTask, method: str) -> Row:
        return {**self._setting(task), "run": task.run, "method": method}


def _estimates(
    method: str, problems: Sequence[Problem], sigma: float
) -> list[Alignment | CadalignError]:
    """A method's estimate of every problem."""
    if method == LIMIT:
        return [_bound(problem) for problem in problems]
    batch = fit_batch(
        [problem.points_3d for problem in problems],
        [problem.points_2d for problem in problems],
        problems[0].camera,
        **fit_options(method, sigma=sigma, ransac=None),
    )
    return [batch.errors.get(b) or batch.alignment(b) for b in range(len(batch))]


def _timed(
    method: str, problem: Problem, sigma: float
) -> tuple[Alignment | CadalignError, float | None]:
    """An estimate, and the time of the quickest of some calls."""
    if method == LIMIT:
        return _bound(problem), None
    best, how = np.inf, fit_options(method, sigma=sigma, ransac=None)
    try:
        for _ in range(_REPEATS):
            start = time.perf_counter()
            result = fit(problem.points_3d, problem.points_2d, problem.camera, **how)
            best = min(best, time.perf_counter() - start)
    except CadalignError as error:
        return error, None
    return result.alignment, best


def _bound(problem: Problem) -> Alignment | CadalignError:
    """The bound of an estimator that knows the outliers."""
    kept = slice(None) if problem.outliers is None else ~problem.outliers
    try:
        return limit_estimate(
            problem.points_3d[kept], problem.points_2d[kept], problem.camera, problem.alignment
        )
    except CadalignError as error:
        return error
