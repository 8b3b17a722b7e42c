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
from cadalign.evaluation.summary import ALL, Summary, group_name
from cadalign.report.runs import group_by_spec

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

    @classmethod
    def from_summary(cls, run: int, line: Summary, columns: Sequence[Metric]) -> HeadlineRow:
        """Convert a summary to a row, in the columns' units."""
        cells = {column.key: column.shown(line.number(column.key)) for column in columns}
        return cls(run, line.group, line.method, cells)


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
    lines = []
    for run in runs:
        found = spec_of(run).summarize(run)
        # The summary over all groups comes first.
        lines.append(sorted(found, key=lambda line: line.group.split(", ")[0] != ALL))
    columns, notes = dict[str, Metric](), list[str]()
    for spec, places in group_by_spec(runs):
        own = [runs[k] for k in places]
        of_spec = [line for k in places for line in lines[k]]
        columns |= {each.key: each for each in spec.shown_columns(of_spec, own)}
        notes.append(spec.note)
    shown = tuple(columns.values())
    rows, failures, skipped = [], [], []
    for index, run in enumerate(runs):
        rows += _mark_best(
            [HeadlineRow.from_summary(index, line, shown) for line in lines[index]], shown
        )
        group = spec_of(run).group(run)
        failures += _reasons(index, run, group, FAILED)
        skipped += _reasons(index, run, group, SKIPPED)
    return Headline(
        group=spec_of(runs[0]).group(runs[0]).heading,
        columns=shown,
        rows=rows,
        failures=failures,
        skipped=skipped,
        note=" ".join(filter(None, dict.fromkeys(notes))),
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
