"""Quartiles of a sweep's errors, and of its running times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.plots import QUARTILES_NOTE, Plot, Trace
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.simulation.experiment import ERRORS
from cadalign.evaluation.simulation.options import SweepKind
from cadalign.evaluation.summary import ConsoleTable, Line, Quartiles, group_name

VARIED = {metric.key: metric for metric in (metrics.NOISE, metrics.POINTS, metrics.OUTLIER_SHARE)}
"""Quantities that a sweep may vary."""


@dataclass(frozen=True)
class SweepSummary:
    """Quartiles of one metric, over the problems that a method solved at one value.

    Parameters
    ----------
    column : str
        The quantity that is varied.
    value : float
        Its value.
    method, metric : str
    runs, failed : int
        Number of problems, and of those that the method did not solve.
    lower_quartile, median, upper_quartile : float
        NaN where it solved none.
    """

    column: str
    value: float
    method: str
    metric: str
    runs: int
    failed: int
    lower_quartile: float
    median: float
    upper_quartile: float

    def cells(self) -> dict[str, Any]:
        """All numbers by name, the value by the name of its column."""
        rest = {name: value for name, value in vars(self).items() if name != "column"}
        return {self.column: rest.pop("value"), **rest}

    @property
    def quartiles(self) -> Quartiles:
        """The three of them."""
        return Quartiles(self.lower_quartile, self.median, self.upper_quartile)


def kind_of(run: Run) -> SweepKind:
    """The sweep that a run makes."""
    given = run.config["sweep"]
    lists = {name: tuple(given[name]) for name in ("values", "methods")}
    return SweepKind(**{**given, **lists})


def varied(run: Run) -> Metric:
    """The quantity that a run varies."""
    return VARIED[kind_of(run).column]


def summarize(run: Run) -> list[SweepSummary]:
    """Quartiles for every metric, method and value, as far as the run is."""
    kind, cells = kind_of(run), run.cells
    if kind.is_timed:
        cells = {**cells, metrics.MICROSECONDS.key: 1e6 * cells["seconds"]}
    summaries = []
    for metric in _metrics(kind):
        for method in kind.methods:
            for value in kind.values:
                chosen = (cells["method"] == method) & (cells[kind.column] == value)
                solved = chosen & (cells["status"] == OK)
                found = Quartiles.of_solved(cells[metric.key][solved].astype(float))
                count, failed = int(chosen.sum()), int((chosen & ~solved).sum())
                if count:
                    names = (kind.column, value, method, metric.key, count, failed)
                    summaries.append(SweepSummary(*names, found.lower, found.median, found.upper))
    return summaries


def lines(summaries: Sequence[SweepSummary]) -> list[Line]:
    """Lines of the headline table, value by value."""
    found: dict[tuple[float, str], dict[str, Any]] = {}
    for s in summaries:
        values = found.setdefault((s.value, s.method), {})
        values |= {"instances": s.runs, "failed": s.failed, s.metric: s.median}
    group = VARIED[summaries[0].column]
    return [
        Line(group_name(group, value), method, found[value, method])
        for value, method in sorted(found, key=lambda key: key[0])
    ]


def console_table(run: Run, summaries: Sequence[SweepSummary]) -> ConsoleTable:
    """Medians of the first metric, a row for each value."""
    metric = summaries[0].metric
    shown = [summary for summary in summaries if summary.metric == metric]
    methods = list(dict.fromkeys(summary.method for summary in shown))
    rows = []
    for value in dict.fromkeys(summary.value for summary in shown):
        row = {s.method: s for s in shown if s.value == value}
        texts = [
            "-" if s is None or s.failed == s.runs else f"{s.median:.4g}"
            for s in map(row.get, methods)
        ]
        rows.append((f"{value:g}", *texts))
    heads = (shown[0].column, *methods)
    return ConsoleTable(f"Median {metric}", (), heads, rows, grouped=False)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Errors, and times where they are measured, against the quantity that is varied."""
    kind, x = kind_of(runs[0]), varied(runs[0])
    found = [summarize(run) for run in runs]
    count = max((summary.runs for summary in found[0]), default=0)
    return [
        Plot(
            id=metric.key,
            x=x,
            y=metric,
            traces=[
                _trace(index, method, metric, x, summaries)
                for index, summaries in enumerate(found)
                for method in kind_of(runs[index]).methods
            ],
            note=QUARTILES_NOTE,
            caption=f"{_held(kind)}{count} problems each; {QUARTILES_NOTE}",
            figure=f"{kind.name}_{metric.key}",
        )
        for metric in _metrics(kind)
    ]


def _trace(
    run: int, method: str, metric: Metric, x: Metric, summaries: Sequence[SweepSummary]
) -> Trace:
    rows = [s for s in summaries if s.metric == metric.key and s.method == method]
    places = [x.factor * row.value for row in rows]
    return Trace.of(run, method, places, [row.quartiles for row in rows], metric)


def _metrics(kind: SweepKind) -> tuple[Metric, ...]:
    return (metrics.MICROSECONDS, *ERRORS) if kind.is_timed else ERRORS


def _held(kind: SweepKind) -> str:
    """The quantities that are held."""
    noise = "" if kind.column == "noise_px" else f"noise {kind.noise_px:g} px, "
    return noise if kind.column == "points" else f"{noise}{kind.points} points, "
