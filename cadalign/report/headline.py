"""Headline table: rows, best values and failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
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
_Part = dict[str, Any]


def headline_of(runs: Sequence[Run]) -> _Part:
    """Make the headline table of comparable runs, in the format of `cadalign.report.page`."""
    spec, lines = spec_of(runs[0]), []
    for run in runs:
        # The summary over all groups comes first.
        found = sorted(spec.summarize(run), key=lambda line: line.group.split(", ")[0] != ALL)
        lines.append(found)
    shown = spec.shown_columns([line for each in lines for line in each], runs)
    rows, failures, skipped = list[_Part](), list[_Part](), list[_Part]()
    for index, run in enumerate(runs):
        own = []
        for line in lines[index]:
            cells = {column.key: column.shown(line.number(column.key)) for column in shown}
            names = {"run": index, "category": line.group, "method": line.method}
            own.append(names | {"cells": cells, "best": list[str]()})
        _mark_best(own, shown)
        rows += own
        group = spec.group(run)
        failures += _reasons(index, run, group, FAILED)
        skipped += _reasons(index, run, group, SKIPPED)
    return {
        "rows": rows,
        "failures": failures,
        "skipped": skipped,
        "columns": [column.column() for column in shown],
        "group": spec.group(runs[0]).heading,
        "note": spec.note,
    }


def _mark_best(rows: Sequence[_Part], columns: Sequence[Metric]) -> None:
    """Mark the best values of each group, except for reference methods."""
    rivals: dict[str, list[_Part]] = {}
    for row in rows:
        if row["method"] not in _REFERENCES:
            rivals.setdefault(row["category"], []).append(row)
    for group in rivals.values():
        for column in columns if len(group) > 1 else ():
            cells = [row["cells"][column.key] for row in group]
            values = [value for value in cells if value is not None]
            if column.better is not None and values:
                best = max(values) if column.better == HIGH else min(values)
                for row, value in zip(group, cells, strict=True):
                    row["best"] += [column.key] if value == best else []


def _reasons(index: int, run: Run, group: Metric, wanted: str) -> list[_Part]:
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
