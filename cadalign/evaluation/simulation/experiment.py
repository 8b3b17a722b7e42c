"""The AEPnP paper's simulation: errors of methods while one thing is varied.

640 x 480 px, f = 150 px, points in [-1, 1)^3, true scales in [0.5, 2]; see
`cadalign.evaluation.simulation.problems.simulate_problem`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from cadalign.errors import CadalignError, InputError
from cadalign.evaluation.accuracy.cramer_rao import limit_estimate
from cadalign.evaluation.accuracy.methods import LIMIT, fit_batch_with, fit_with
from cadalign.evaluation.accuracy.outcome import FAILED, OK
from cadalign.evaluation.runs.work import Columns, Result, Row
from cadalign.evaluation.simulation.problems import Problem, simulate_problem
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.metrics import rotation_error, scale_error, translation_error
from cadalign.seeding import instance_rng

_REPEATS = 5
SWEEP_METRICS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")


@dataclass(frozen=True)
class SweepKind:
    """What is varied, and what is held.

    Parameters
    ----------
    name : str
    column : str
        The column of the result table that is varied.
    values : tuple of float
        Its values.
    points : int
    noise_px : float
        [px]
    outlier_share : float
    methods : tuple of str
    runs : int
        Problems for each value.
    """

    name: str
    column: str
    values: tuple[float, ...]
    points: int = 1024
    noise_px: float = 2.0
    outlier_share: float = 0.0
    methods: tuple[str, ...] = ("optimal", "aepnp", "aepnp-paper", "epnp", LIMIT)
    runs: int = 2000

    @property
    def is_timed(self) -> bool:
        """Whether the running time is what it is about."""
        return self.name == "runtime"


SWEEPS = {
    kind.name: kind
    for kind in (
        SweepKind("noise", "noise_px", (0.5, *(float(noise) for noise in range(1, 11)))),
        SweepKind("points", "points", (6, 7, 8, 10, 15, 20, 50, 100, 200, 500, 1024)),
        SweepKind(
            "outliers",
            "outlier_share",
            tuple(round(0.1 * tenth, 1) for tenth in range(8)),
            points=100,
            methods=("ransac-optimal", "ransac-aepnp", "optimal-cauchy", "optimal", LIMIT),
            runs=500,
        ),
        SweepKind(
            "runtime",
            "points",
            (6, 10, 20, 50, 100, 200, 500, 1024, 2048),
            methods=("optimal", "aepnp", "aepnp-paper", "epnp"),
            runs=100,
        ),
    )
}


@dataclass(frozen=True)
class SweepTask:
    """One random problem.

    Parameters
    ----------
    value : float
        What is varied.
    run : int
    """

    value: float
    run: int


class SweepTasks(Sequence[SweepTask]):
    """All problems of a sweep, value by value, made when asked for.

    Parameters
    ----------
    values : sequence of float
    runs : int
        Problems for each value.
    """

    def __init__(self, values: Sequence[float], runs: int) -> None:
        self._values = tuple(values)
        self._runs = runs

    def __len__(self) -> int:
        return len(self._values) * self._runs

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place, run = divmod(range(len(self))[index], self._runs)
        return SweepTask(self._values[place], run)


@dataclass(frozen=True)
class SweepExperiment:
    """Evaluates methods on random problems.

    Parameters
    ----------
    kind : SweepKind
    seed : int
    """

    kind: SweepKind
    seed: int = 0

    @property
    def columns(self) -> Columns:
        """The columns of the result table."""
        names: Columns = (
            ("points", int),
            ("noise_px", float),
            ("outlier_share", float),
            ("run", int),
            ("method", str),
            ("status", str),
            ("reason", str),
        )
        return (*names, *((name, float) for name in SWEEP_METRICS))

    @property
    def timing_columns(self) -> Columns:
        """The problem, the method, and its seconds: of one call where time is what is varied."""
        return (("points", int), ("run", int), ("method", str), ("seconds", float))

    def warm_up(self) -> None:
        """Compile the solvers."""
        self.evaluate([SweepTask(self.kind.values[0], 0)])

    def evaluate(self, tasks: Sequence[SweepTask]) -> Result:
        """A row for every task and method."""
        return Result.joined(
            [part for _, some in groupby(tasks, _value) for part in self._evaluate_same(list(some))]
        )

    def failure(self, task: SweepTask, reason: str) -> Result:
        """A failed row for every method."""
        return Result.joined(
            [
                Result([self._failed(task, method, reason)], [self._timing(task, method, None)])
                for method in self.kind.methods
            ]
        )

    def problem(self, task: SweepTask) -> Problem:
        """The problem of a task."""
        setting = self._setting(task)
        rng = instance_rng(self.seed, self.kind.name, repr(float(task.value)), str(task.run))
        return simulate_problem(
            rng,
            points=setting["points"],
            noise_px=setting["noise_px"],
            outlier_share=setting["outlier_share"],
        )

    def _evaluate_same(self, tasks: Sequence[SweepTask]) -> list[Result]:
        """Tasks of one value: methods are told the standard deviation of the noise."""
        problems = [self.problem(task) for task in tasks]
        sigma = self._setting(tasks[0])["noise_px"] or 1.0
        per_method = [self._run(method, tasks, problems, sigma) for method in self.kind.methods]
        return [part for parts in zip(*per_method, strict=True) for part in parts]

    def _setting(self, task: SweepTask) -> Row:
        """Points, noise and outliers of a task."""
        kind = self.kind
        held = {"points": kind.points, "noise_px": kind.noise_px}
        setting = {**held, "outlier_share": kind.outlier_share, kind.column: task.value}
        setting["points"] = int(setting["points"])
        return setting

    def _run(
        self, method: str, tasks: Sequence[SweepTask], problems: Sequence[Problem], sigma: float
    ) -> list[Result]:
        """One method's result for every task."""
        if self.kind.is_timed:
            timed = [_timed(method, problem, sigma) for problem in problems]
            estimates: list[Alignment | CadalignError] = [estimate for estimate, _ in timed]
            seconds: list[float | None] = [second for _, second in timed]
        else:
            start = time.perf_counter()
            estimates = _estimates(method, problems, sigma)
            seconds = [(time.perf_counter() - start) / len(problems)] * len(problems)
        return [
            Result([self._row(task, method, problem, est)], [self._timing(task, method, second)])
            for task, problem, est, second in zip(tasks, problems, estimates, seconds, strict=True)
        ]

    def _row(
        self, task: SweepTask, method: str, problem: Problem, est: Alignment | CadalignError
    ) -> Row:
        if isinstance(est, CadalignError):
            return self._failed(task, method, str(est))
        gt = problem.alignment
        _, scale_y, scale_z = scale_error(est=est, gt=gt).tolist()
        errors = (rotation_error(est=est, gt=gt), translation_error(est=est, gt=gt))
        metrics = dict(zip(SWEEP_METRICS, (*errors, scale_y, scale_z), strict=True))
        return {**self._names(task, method), "status": OK, "reason": "", **metrics}

    def _failed(self, task: SweepTask, method: str, reason: str) -> Row:
        return {**self._names(task, method), "status": FAILED, "reason": reason}

    def _names(self, task: SweepTask, method: str) -> Row:
        return {**self._setting(task), "run": task.run, "method": method}

    def _timing(self, task: SweepTask, method: str, seconds: float | None) -> Row:
        points = self._setting(task)["points"]
        return {"points": points, "run": task.run, "method": method, "seconds": seconds}


def _value(task: SweepTask) -> float:
    return task.value


def _estimates(
    method: str, problems: Sequence[Problem], sigma: float
) -> list[Alignment | CadalignError]:
    """What a method makes of every problem."""
    if method == LIMIT:
        return [_limit(problem) for problem in problems]
    batch = fit_batch_with(
        method,
        [problem.points_3d for problem in problems],
        [problem.points_2d for problem in problems],
        problems[0].camera,
        sigma=sigma,
    )
    return [batch.errors[b] if b in batch.errors else batch.alignment(b) for b in range(len(batch))]


def _timed(
    method: str, problem: Problem, sigma: float
) -> tuple[Alignment | CadalignError, float | None]:
    """An estimate, and the time of the quickest of some calls."""
    if method == LIMIT:
        return _limit(problem), None
    best = np.inf
    try:
        for _ in range(_REPEATS):
            start = time.perf_counter()
            result = fit_with(
                method, problem.points_3d, problem.points_2d, problem.camera, sigma=sigma
            )
            best = min(best, time.perf_counter() - start)
    except CadalignError as error:
        return error, None
    return result.alignment, best


# What may be varied: a check, what it is, and what to give.
_CHECKS: dict[str, tuple[Callable[[float], bool], str, str]] = {
    "points": (
        lambda value: value >= 4 and value == int(value),
        "a number of points",
        "give 4 or more",
    ),
    "noise_px": (lambda value: 0 <= value < np.inf, "a noise level", "give pixels, 0 or more"),
    "outlier_share": (lambda value: 0 <= value < 1, "a share", "give 0 to 0.95"),
}


def check_values(kind: SweepKind) -> SweepKind:
    """Return the sweep if its values make sense.

    Raises
    ------
    InputError
        If one does not.
    """
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
    return kind


def _limit(problem: Problem) -> Alignment | CadalignError:
    """The limit of an estimator that knows which observations are outliers."""
    kept = slice(None) if problem.outliers is None else ~problem.outliers
    try:
        return limit_estimate(
            problem.points_3d[kept], problem.points_2d[kept], problem.camera, problem.alignment
        )
    except CadalignError as error:
        return error
