"""Headline tables: their rows, the best values, the failures by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from cadalign.evaluation.methods.method import LIMIT
from cadalign.evaluation.metrics.table import HIGH, Metric
from cadalign.evaluation.outcome import FAILED, SKIPPED
from cadalign.evaluation.photos.protocols import TRUTH
from cadalign.evaluation.registry import spec_of
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.summary import ALL, Summary, group_name
from cadalign.report.runs import by_spec

_MOST_REASONS = 200
_REFERENCES = {LIMIT, TRUTH, "exact"}
"""Methods that know what nobody does: the bound, the object's own model, the true pose."""
OTHER_REASONS = "other reasons"


@dataclass(frozen=True)
class HeadlineRow:
    """Numbers of one method on one group of tasks of a run.

    ``cells`` are as displayed, None where there is none; ``best`` are the columns in which no
    method did better on the same group.
    """

    run: int
    category: str
    method: str
    cells: dict[str, float | None]
    best: tuple[str, ...] = ()

    @classmethod
    def of(cls, run: int, line: Summary, columns: Sequence[Metric]) -> HeadlineRow:
        """A row of a line's values, in the columns' units."""
        cells = {column.key: column.shown(line.number(column.key)) for column in columns}
        return cls(run, line.group, line.method, cells)


@dataclass(frozen=True)
class Failure:
    """A reason of failures or of skipped instances, and their number."""

    run: int
    category: str
    method: str
    reason: str
    count: int


@dataclass(frozen=True)
class Headline:
    """The headline table; ``paper`` are published numbers on the same groups."""

    group: str
    columns: tuple[Metric, ...]
    rows: list[HeadlineRow]
    failures: list[Failure]
    skipped: list[Failure]
    paper: list[HeadlineRow]
    note: str

    def to_dict(self) -> dict[str, Any]:
        """The table for the page."""
        return {
            "group": self.group,
            "columns": [column.column() for column in self.columns],
            "rows": [asdict(row) for row in self.rows],
            "failures": [asdict(failure) for failure in self.failures],
            "skipped": [asdict(reason) for reason in self.skipped],
            "paper": [
                {"category": row.category, "method": row.method, "cells": row.cells}
                for row in self.paper
            ],
            "note": self.note,
        }


def headline_of(runs: Sequence[Run]) -> Headline:
    """The headline table of runs of one kind."""
    lines = [_all_first(spec_of(run).lines(spec_of(run).summarize(run))) for run in runs]
    columns, notes, stated = dict[str, Metric](), list[str](), list[Summary]()
    for spec, places in by_spec(runs):
        own = [runs[k] for k in places]
        of_spec = [line for k in places for line in lines[k]]
        columns |= {each.key: each for each in spec.shown_columns(of_spec, own)}
        reference = spec.reference(own, {line.group for line in of_spec})
        stated += reference.lines
        notes += [spec.note, reference.note]
    shown = tuple(columns.values())
    rows, failures, skipped = [], [], []
    for index, run in enumerate(runs):
        rows += _with_best([HeadlineRow.of(index, line, shown) for line in lines[index]], shown)
        group = spec_of(run).group(run)
        failures += _reasons(index, run, group, FAILED)
        skipped += _reasons(index, run, group, SKIPPED)
    return Headline(
        group=spec_of(runs[0]).group(runs[0]).heading,
        columns=shown,
        rows=rows,
        failures=failures,
        skipped=skipped,
        paper=[HeadlineRow.of(0, line, shown) for line in stated],
        note=" ".join(filter(None, dict.fromkeys(notes))),
    )


def _all_first(lines: Sequence[Summary]) -> list[Summary]:
    """The lines of all groups together before those of single ones, otherwise in their order."""
    return sorted(lines, key=lambda line: line.group.split(", ")[0] != ALL)


def _with_best(rows: Sequence[HeadlineRow], columns: Sequence[Metric]) -> list[HeadlineRow]:
    """The rows with the best ones marked, among methods on the same that one could use."""
    best: dict[tuple[str, str], float] = {}
    rivals = [row for row in rows if row.method not in _REFERENCES]
    for column in columns:
        choose = max if column.better == HIGH else min
        for row in rivals:
            value = row.cells[column.key]
            if column.better is not None and value is not None:
                place = (row.category, column.key)
                best[place] = choose(best.get(place, value), value)
    counts = Counter(row.category for row in rivals)

    def marked(row: HeadlineRow) -> tuple[str, ...]:
        if row.method in _REFERENCES or counts[row.category] < 2:
            return ()
        return tuple(
            column.key
            for column in columns
            if row.cells[column.key] is not None
            and row.cells[column.key] == best.get((row.category, column.key))
        )

    return [replace(row, best=marked(row)) for row in rows]


def _reasons(index: int, run: Run, group: Metric, wanted: str) -> list[Failure]:
    """Reasons with their numbers, the most frequent first; rare ones beyond a number as one."""
    chosen = [run.results[name].to_pylist() for name in (group.key, "method", "status", "reason")]
    counts = Counter(
        (group_name(group, value), method, reason)
        for value, method, status, reason in zip(*chosen, strict=True)
        if status == wanted
    )
    listed = counts.most_common(_MOST_REASONS)
    rest: Counter[tuple[str, str, str]] = Counter()
    for (category, method, _), count in counts.most_common()[_MOST_REASONS:]:
        rest[category, method, OTHER_REASONS] += count
    return [Failure(index, *names, count) for names, count in (*listed, *rest.items())]
