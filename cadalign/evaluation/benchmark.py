"""Benchmarks: instances x methods x metrics, for all experiments.

A `Setting` makes instances, the input of methods, and the metrics of estimates. A `Benchmark` runs
methods on them. A failure becomes a row with a reason and never stops a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

from cadalign.errors import DataError
from cadalign.evaluation.methods import (
    FunctionMetric,
    Method,
    MethodInput,
    choose_methods,
    choose_metrics,
)
from cadalign.evaluation.options import ExperimentOptions
from cadalign.evaluation.runs.work import (
    FAILED,
    AbortError,
    Columns,
    Outcome,
    Plan,
    Row,
    reason_of,
    status_of,
)

R = TypeVar("R")
T = TypeVar("T")
Pair = tuple[Any, Any]
"""An instance and an estimate of it."""
VIEW_NAMES: Columns = (("category", str), ("model_id", str), ("view", int), ("method", str))
"""Columns that identify a row of a method on a view of a model."""


@dataclass(frozen=True)
class Case:
    """An instance with the cells that identify its rows, or the error that prevents it."""

    names: Row  # without the method
    facts: Row = field(default_factory=dict)  # cells that do not depend on the estimate
    instance: Any = None
    error: Exception | None = None  # set if there is no instance


class Setting:
    """Instances and metrics of a benchmark; picklable.

    Subclasses define ``columns``, ``case`` or ``cases``, and ``row`` or ``measure``.
    """

    record_columns: ClassVar[Columns] = ()
    """Columns of the table of instance records; empty for settings without records."""

    @property
    def columns(self) -> Columns:
        """Columns of the result table."""
        raise NotImplementedError

    def case(self, task: Any) -> Case:
        """Make the instance of a task; raises if that is impossible."""
        raise NotImplementedError

    def cases(self, tasks: Sequence[Any]) -> list[Case]:
        """Make the instances of tasks, in their order."""
        return [case for task in tasks for case in self._cases(task)]

    def _cases(self, task: Any) -> list[Case]:
        found = attempt(self.case, task)
        return [
            replace(self.failed_case(task), error=found) if isinstance(found, Exception) else found
        ]

    def failed_case(self, task: Any) -> Case:
        """The case of a task that could not be evaluated, without an instance."""
        return Case(task.names)

    def method_input(self, instance: Any) -> MethodInput:
        """The input of general methods; by default the instance itself."""
        found: MethodInput = instance
        return found

    def estimate_of(self, method: Method, instance: Any, answer: Any) -> Any:
        """Convert a general method's alignment or result to the estimate that is measured."""
        return answer

    def row(self, method: Method, instance: Any, estimate: Any) -> Row:
        """Cells of the result table for an estimate; raises if it cannot be measured."""
        raise NotImplementedError

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Cells of the result table for each estimate, or an error."""
        return [attempt(self.row, method, *pair) for pair in pairs]

    def finish(self, case: Case, outcomes: list[Outcome], estimates: list[Any]) -> str | None:
        """Return the record of an instance after all methods, and write its pictures."""
        return None


@dataclass(frozen=True)
class Benchmark:
    """An experiment of the engine that runs methods on the instances of a setting."""

    setting: Setting
    methods: tuple[Method, ...]
    batched: frozenset[str] = frozenset()
    """Methods that solve all instances of a chunk at once; the time is shared among instances."""
    metrics: tuple[FunctionMetric, ...] = ()  # metrics of users' functions

    @classmethod
    def from_methods(
        cls,
        setting: Setting,
        methods: Iterable[str],
        own: Mapping[str, Method] | None = None,
        *,
        metrics: Iterable[str] = (),
        **how: Any,
    ) -> Benchmark:
        """Make a benchmark of methods and metrics; see `cadalign.evaluation.methods`."""
        further = choose_metrics(metrics, setting.columns)
        return cls(setting, choose_methods(methods, own), metrics=further, **how)

    @property
    def columns(self) -> Columns:
        """Columns of the result table."""
        return (*self.setting.columns, *((each.metric.key, float) for each in self.metrics))

    @property
    def record_columns(self) -> Columns:
        """Columns of the table of instance records."""
        return self.setting.record_columns

    def plan(
        self, options: ExperimentOptions, tasks: Sequence[T], *, chunk: int = 8, **more: Any
    ) -> Plan[T]:
        """Plan a run by chunks of tasks; ``more`` adds to the options in its configuration."""
        return Plan(self, tasks, options.as_config() | more, chunk)

    def evaluate(self, tasks: Sequence[Any]) -> list[Row]:
        """One row per instance and method; the first row of an instance has its record."""
        cases = self.setting.cases(tasks)
        blank = self._blank
        answers = zip(*(self._answers(method, cases) for method in self.methods), strict=True)
        rows: list[Row] = []
        for case, each in zip(cases, answers, strict=True):
            outcomes = [outcome for outcome, _ in each]
            own = [blank | outcome.row() for outcome in outcomes]
            if case.instance is not None:
                record = self.setting.finish(case, outcomes, [estimate for _, estimate in each])
                if record is not None:
                    own[0][self.record_columns[-1][0]] = record
            rows += own
        return rows

    def failure(self, task: Any, reason: str) -> list[Row]:
        """One failed row per method."""
        case = self.setting.failed_case(task)
        return [
            self._blank
            | Outcome({**case.names, "method": method.name}, case.facts, FAILED, reason).row()
            for method in self.methods
        ]

    @property
    def _blank(self) -> Row:
        """Empty texts for a row: a result table has no missing texts."""
        return {name: "" for name, kind in self.columns if kind is str}

    def _answers(self, method: Method, cases: Sequence[Case]) -> list[tuple[Outcome, Any]]:
        """Outcome of a method for every case, with its estimate or an error."""
        instances = [case.instance for case in cases if case.instance is not None]
        solved = self._solve(method, instances)
        pairs = [
            (instance, estimate)
            for instance, (estimate, _) in zip(instances, solved, strict=True)
            if not isinstance(estimate, Exception)
        ]
        estimates, rows = iter(solved), iter(self._measure(method, pairs))
        answers: list[tuple[Outcome, Any]] = []
        for case in cases:
            estimate: Any = case.error or ValueError("there is no instance")
            seconds: float | None = None
            if case.instance is not None:
                estimate, seconds = next(estimates)
            row = estimate if isinstance(estimate, Exception) else next(rows)
            names = {**case.names, "method": method.name}
            if isinstance(row, Exception):
                outcome = Outcome(names, case.facts, status_of(row), reason_of(row), seconds)
                answers.append((outcome, row))
            else:
                answers.append((Outcome(names, case.facts | row, seconds=seconds), estimate))
        return answers

    def _measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Cells of each estimate, users' metrics included, or an error."""
        rows = self.setting.measure(method, pairs) if pairs else []
        if not self.metrics:
            return rows
        return [
            row if isinstance(row, Exception) else attempt(self._measure_metrics, row, *pair)
            for pair, row in zip(pairs, rows, strict=True)
        ]

    def _measure_metrics(self, row: Row, instance: Any, estimate: Any) -> Row:
        given = self.setting.method_input(instance)
        return row | {each.metric.key: each.measure(estimate, given) for each in self.metrics}

    def _solve(self, method: Method, instances: Sequence[Any]) -> list[tuple[Any, float | None]]:
        """A method's estimate of every instance, or an error, and the seconds."""
        if method.name not in self.batched or method.solve_many is None:
            return [self._solve_one(method, instance) for instance in instances]
        start = time.perf_counter()
        answers = method.solve_many([self.setting.method_input(each) for each in instances])
        found = [
            answer
            if isinstance(answer, Exception)
            else self.setting.estimate_of(method, instance, answer)
            for instance, answer in zip(instances, answers, strict=True)
        ]
        share = (time.perf_counter() - start) / max(len(instances), 1)
        return [(estimate, share) for estimate in found]

    def _solve_one(self, method: Method, instance: Any) -> tuple[Any, float | None]:
        """A method's estimate of one instance, or an error, and the seconds."""
        given = attempt(self.setting.method_input, instance) if method.is_general else instance
        if isinstance(given, Exception):
            return given, None
        start = time.perf_counter()
        answer = attempt(method.solve, given)
        seconds = time.perf_counter() - start
        if method.is_general and not isinstance(answer, Exception):
            answer = attempt(self.setting.estimate_of, method, instance, answer)
        return answer, seconds


def attempt(function: Callable[..., R], *arguments: Any) -> R | Exception:
    """Return a function's value or the error that it raises; `AbortError` stops the run."""
    try:
        return function(*arguments)
    except AbortError:
        raise
    except Exception as error:
        return error


def write_picture(write: Callable[..., object], *arguments: Any) -> None:
    """Write an instance's pictures; raises AbortError if a file cannot be written."""
    try:
        write(*arguments)
    except (OSError, DataError) as error:
        raise AbortError(
            f"a picture cannot be written: {error}",
            fix="free some space and start the same command again: the run continues",
        ) from None
