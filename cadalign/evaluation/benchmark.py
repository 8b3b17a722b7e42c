"""Benchmarks: instances x methods x metrics, the one walk of all experiments.

A `Setting` makes the instances of tasks, gives them to methods, and measures estimates; `Benchmark`
runs methods on them. An instance or an estimate that fails is a row with a reason, and never stops
a run.
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
"""An instance, and an estimate of it."""
VIEW_NAMES: Columns = (("category", str), ("model_id", str), ("view", int), ("method", str))
"""The columns that name a row of a method on a view of a model."""


@dataclass(frozen=True)
class Case:
    """An instance with the cells that name its rows, or why there is none."""

    names: Row  # all but the method
    facts: Row = field(default_factory=dict)  # cells that do not depend on the estimate
    instance: Any = None
    error: Exception | None = None  # why there is no instance


class Setting:
    """Instances and metrics of a benchmark; picklable.

    A setting has ``columns``, ``case`` or ``cases``, and ``row`` or ``measure``.
    """

    record_columns: ClassVar[Columns] = ()
    """The columns of the table of instance records; none of a setting without."""

    @property
    def columns(self) -> Columns:
        """All columns of the result table."""
        raise NotImplementedError

    def case(self, task: Any) -> Case:
        """The instance of a task; one that cannot be made raises."""
        raise NotImplementedError

    def cases(self, tasks: Sequence[Any]) -> list[Case]:
        """The instances of tasks, in their order."""
        return [case for task in tasks for case in self._cases(task)]

    def _cases(self, task: Any) -> list[Case]:
        found = attempt(self.case, task)
        return [replace(self.failed(task), error=found) if isinstance(found, Exception) else found]

    def failed(self, task: Any) -> Case:
        """The case, without an instance, of a task that could not be evaluated."""
        return Case(task.names)

    def given(self, instance: Any) -> MethodInput:
        """The instance as general methods are given it; by default it is that."""
        found: MethodInput = instance
        return found

    def answered(self, method: Method, instance: Any, answer: Any) -> Any:
        """The estimate that is measured, of a general method's alignment or result."""
        return answer

    def row(self, method: Method, instance: Any, estimate: Any) -> Row:
        """Cells of the result table for an estimate; one that cannot be measured raises."""
        raise NotImplementedError

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Cells of the result table for each estimate, or why there are none."""
        return [attempt(self.row, method, *pair) for pair in pairs]

    def finish(self, case: Case, outcomes: list[Outcome], estimates: list[Any]) -> str | None:
        """The record of an instance, and its pictures, once all methods were run."""
        return None


@dataclass(frozen=True)
class Benchmark:
    """Runs methods on the instances of a setting; an experiment of the engine."""

    setting: Setting
    methods: tuple[Method, ...]
    batched: frozenset[str] = frozenset()
    """Methods that are given all instances of a chunk at once, and share the time among them."""
    metrics: tuple[FunctionMetric, ...] = ()  # further columns of the result table

    @classmethod
    def chosen(
        cls,
        setting: Setting,
        methods: Iterable[str],
        own: Mapping[str, Method] | None = None,
        *,
        metrics: Iterable[str] = (),
        **how: Any,
    ) -> Benchmark:
        """The benchmark of methods and of functions; see `cadalign.evaluation.methods`."""
        further = choose_metrics(metrics, setting.columns)
        return cls(setting, choose_methods(methods, own), metrics=further, **how)

    @property
    def columns(self) -> Columns:
        """The columns of the result table."""
        return (*self.setting.columns, *((each.metric.key, float) for each in self.metrics))

    @property
    def record_columns(self) -> Columns:
        """The columns of the table of instance records."""
        return self.setting.record_columns

    def plan(
        self, options: ExperimentOptions, tasks: Sequence[T], *, chunk: int, **more: Any
    ) -> Plan[T]:
        """The plan of a run, with more of its configuration than the options."""
        return Plan(self, tasks, options.as_config() | more, chunk)

    def evaluate(self, tasks: Sequence[Any]) -> list[Row]:
        """A row for every instance and method; the first of an instance has its record."""
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
        """A failed row for every method."""
        case = self.setting.failed(task)
        return [
            self._blank
            | Outcome({**case.names, "method": method.name}, case.facts, FAILED, reason).row()
            for method in self.methods
        ]

    @property
    def _blank(self) -> Row:
        """Texts of a row that says nothing: no text of a result table is missing."""
        return {name: "" for name, kind in self.columns if kind is str}

    def _answers(self, method: Method, cases: Sequence[Case]) -> list[tuple[Outcome, Any]]:
        """Outcome and estimate of a method for every case; an error where there is no estimate."""
        instances = [case.instance for case in cases if case.instance is not None]
        solved = self._solved(method, instances)
        pairs = [
            (instance, estimate)
            for instance, (estimate, _) in zip(instances, solved, strict=True)
            if not isinstance(estimate, Exception)
        ]
        estimates, rows = iter(solved), iter(self._measured(method, pairs))
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

    def _measured(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """The cells of each estimate, those of further metrics too, or why there are none."""
        rows = self.setting.measure(method, pairs) if pairs else []
        if not self.metrics:
            return rows
        return [
            row if isinstance(row, Exception) else attempt(self._further, row, *pair)
            for pair, row in zip(pairs, rows, strict=True)
        ]

    def _further(self, row: Row, instance: Any, estimate: Any) -> Row:
        given = self.setting.given(instance)
        return row | {each.metric.key: each.measure(estimate, given) for each in self.metrics}

    def _solved(self, method: Method, instances: Sequence[Any]) -> list[tuple[Any, float | None]]:
        """A method's estimate of every instance, or why there is none, and its seconds."""
        if method.name not in self.batched or method.solve_many is None:
            return [self._timed(method, instance) for instance in instances]
        start = time.perf_counter()
        answers = method.solve_many([self.setting.given(each) for each in instances])
        found = [
            answer
            if isinstance(answer, Exception)
            else self.setting.answered(method, instance, answer)
            for instance, answer in zip(instances, answers, strict=True)
        ]
        share = (time.perf_counter() - start) / max(len(instances), 1)
        return [(estimate, share) for estimate in found]

    def _timed(self, method: Method, instance: Any) -> tuple[Any, float | None]:
        """An estimate of one instance, or why there is none, and its seconds."""
        given = attempt(self.setting.given, instance) if method.is_general else instance
        if isinstance(given, Exception):
            return given, None
        start = time.perf_counter()
        answer = attempt(method.solve, given)
        seconds = time.perf_counter() - start
        if method.is_general and not isinstance(answer, Exception):
            answer = attempt(self.setting.answered, method, instance, answer)
        return answer, seconds


def attempt(function: Callable[..., R], *arguments: Any) -> R | Exception:
    """The value of a function, or the error that it raises; `AbortError` stops the run."""
    try:
        return function(*arguments)
    except AbortError:
        raise
    except Exception as error:
        return error


def write_picture(write: Callable[..., object], *arguments: Any) -> None:
    """Write an instance's pictures; where there is no room for them, the run is stopped."""
    try:
        write(*arguments)
    except (OSError, DataError) as error:
        raise AbortError(
            f"a picture cannot be written: {error}",
            fix="free some space, and start the same command again: the run goes on",
        ) from None
