"""Headline table: rows, best values and failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from cadalign.evaluation.experiments.photos import TRUTH
from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.metrics import HIGH, Metric
from cadalign.evaluation.registry import spec_of
from cadalign.evaluation.runs.tables import Run
from cadalign.evaluation.runs.work import FAILED, SKIPPED
from cadalign.evaluation.summary import ALL, group_name

_MOST_REASONS = 200
_REFERENCES = {LIMIT, TRUTH, "exact"}
"""Methods with information that is unknown in practice, such as the true pose."""


@dataclass(frozen=True)
class HeadlineRow:
    """Values of one method on one group of a run's tasks.

    ``cells`` are displayed values, None where unknown; ``best`` are the columns in which no method
    of the group is better.
    """

    run: int
    category: str
    method: str
    cells: dict[str, float | None]
    best: tuple[str, ...] = ()


Failure = dict[str, Any]
"""A ``reason``, the ``count`` of failed or skipped instances, run, category and method."""


@dataclass(frozen=True)
class Headline:
    """The headline table."""

    group: str
    columns: tuple[Metric, ...]
    rows: list[HeadlineRow]
    failures: list[Failure] = field(default_factory=list)
    skipped: list[Failure] = field(default_factory=list)
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The table in the page's format."""
        return {
            "rows": list(map(asdict, self.rows)),
            "failures": self.failures,
            "skipped": self.skipped,
            "columns": [column.column() for column in self.columns],
            "group": self.group,
            "note": self.note,
        }


def headline_of(runs: Sequence[Run]) -> Headline:
    """Make the headline table of comparable runs."""
    spec, lines = spec_of(runs[0]), []
    for run in runs:
        # The summary over all groups comes first.
        found = sorted(spec.summarize(run), key=lambda line: line.group.split(", ")[0] != ALL)
        lines.append(found)
    shown = tuple(spec.shown_columns([line for each in lines for line in each], runs))
    rows, failures, skipped = [], [], []
    for index, run in enumerate(runs):
        own = []
        for line in lines[index]:
            cells = {column.key: column.shown(line.number(column.key)) for column in shown}
            own.append(HeadlineRow(index, line.group, line.method, cells))
        rows += _mark_best(own, shown)
        group = spec.group(run)
        failures += _reasons(index, run, group, FAILED)
        skipped += _reasons(index, run, group, SKIPPED)
    return Headline(
        group=spec.group(runs[0]).heading,
        columns=shown,
        rows=rows,
        failures=failures,
        skipped=skipped,
        note=spec.note,
    )


def _mark_best(rows: Sequence[HeadlineRow], columns: Sequence[Metric]) -> list[HeadlineRow]:
    """Mark the best values of each group, except for reference methods."""
    rivals: dict[str, list[HeadlineRow]] = {}
    for row in rows:
        if row.method not in _REFERENCES:
            rivals.setdefault(row.category, []).append(row)
    marked: dict[int, tuple[str, ...]] = {}
    for group in rivals.values():
        best = {}
        for column in columns if len(group) > 1 else ():
            values = [v for row in group if (v := row.cells[column.key]) is not None]
            if column.better is not None and values:
                best[column.key] = max(values) if column.better == HIGH else min(values)
        for row in group:
            marked[id(row)] = tuple(key for key, value in best.items() if row.cells[key] == value)
    return [replace(row, best=marked.get(id(row), ())) for row in rows]


def _reasons(index: int, run: Run, group: Metric, wanted: str) -> list[Failure]:
    """Count the reasons of a status, the most frequent first."""
    chosen = [run.results[name].to_pylist() for name in (group.key, "method", "status", "reason")]
    counts = Counter(
        (group_name(group, value), method, reason)
        for value, method, status, reason in zip(*chosen, strict=True)
        if status == wanted
    )
    return [
        {"run": index, "category": category, "method": method, "reason": reason, "count": count}
        for (category, method, reason), count in counts.most_common(_MOST_REASONS)
    ]
