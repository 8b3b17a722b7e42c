"""Specification of the simulation.

A summary is of one metric, over the problems that a method solved at one value. Its cells: ``runs``
and ``failed``, the number of problems and of those that the method did not solve, and
``lower_quartile``, ``median`` and ``upper_quartile``, NaN where it solved none.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict

from cadalign.errors import DataError
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.plots import QUARTILES_NOTE, Plot, Trace
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.simulation.experiment import (
    COLUMNS,
    ERRORS,
    SweepTask,
    sweep_benchmark,
    sweep_tasks,
)
from cadalign.evaluation.simulation.options import SWEEPS, SweepKind, SweepOptions
from cadalign.evaluation.spec import Spec
from cadalign.evaluation.summary import ConsoleTable, Quartiles, Summary, group_name
from cadalign.io.documents import convert, in_file

VARIED = {metric.key: metric for metric in (metrics.NOISE, metrics.POINTS, metrics.OUTLIER_SHARE)}
"""Quantities that a sweep may vary."""


def kind_of(run: Run) -> SweepKind:
    """The sweep that a run makes."""
    given = run.config.get("sweep")
    # What an older run does not say is as in this sweep.
    stated = {**asdict(SWEEPS["noise"]), **given} if isinstance(given, dict) else given
    with in_file(run.folder.config_file):
        found: SweepKind = convert(stated, SweepKind, "sweep")
        if any(abs(value) > sys.float_info.max for value in found.values):
            raise DataError("a value is beyond all numbers", where="sweep.values")
    return found


def varied(run: Run) -> Metric:
    """The quantity that a run varies."""
    return VARIED[kind_of(run).column]


def summarize(run: Run) -> list[Summary]:
    """Quartiles for every metric, method and value, as far as the run is."""
    kind, cells = kind_of(run), run.cells
    if kind.is_timed:
        cells = {**cells, metrics.MICROSECONDS.key: 1e6 * cells["seconds"]}
    summaries = []
    for metric in _metrics(kind, run):
        for method in kind.methods:
            for value in kind.values:
                chosen = (cells["method"] == method) & (cells[kind.column] == value)
                solved = chosen & (cells["status"] == OK)
                found = Quartiles.of_solved(cells[metric.key][solved].astype(float))
                count, failed = int(chosen.sum()), int((chosen & ~solved).sum())
                if not count:
                    continue
                names = {"value": value, "method": method, "metric": metric.key}
                values = {
                    "runs": count,
                    "failed": failed,
                    "lower_quartile": found.lower,
                    "median": found.median,
                    "upper_quartile": found.upper,
                }
                group = group_name(VARIED[kind.column], value)
                summaries.append(Summary(group, names, values, tasks=count))
    return summaries


def lines(summaries: Sequence[Summary]) -> list[Summary]:
    """Lines of the headline table, value by value, with the medians of all metrics."""
    found: dict[tuple[float, str], Summary] = {}
    for s in sorted(summaries, key=lambda s: float(s["value"])):
        place = s["value"], s.method
        values = found[place].values if place in found else {"failed": s["failed"]}
        names = {"value": s["value"], "method": s.method}
        found[place] = Summary(s.group, names, {**values, s["metric"]: s["median"]}, s.tasks)
    return list(found.values())


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """Medians of the first metric, a row for each value."""
    metric = summaries[0]["metric"]
    shown = [summary for summary in summaries if summary["metric"] == metric]
    methods = list(dict.fromkeys(summary.method for summary in shown))
    rows = []
    for value in dict.fromkeys(summary["value"] for summary in shown):
        row = {s.method: s for s in shown if s["value"] == value}
        texts = [
            "-" if s is None or s["failed"] == s["runs"] else f"{s['median']:.4g}"
            for s in map(row.get, methods)
        ]
        rows.append((f"{value:g}", *texts))
    heads = (kind_of(run).column, *methods)
    return ConsoleTable(f"Median {metric}", (), heads, rows, "", grouped=False)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Errors, and times where they are measured, against the quantity that is varied."""
    kind, x = kind_of(runs[0]), varied(runs[0])
    found = [summarize(run) for run in runs]
    count = max((summary["runs"] for summary in found[0]), default=0)
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
        for metric in _metrics(kind, runs[0])
    ]


def _trace(run: int, method: str, metric: Metric, x: Metric, summaries: Sequence[Summary]) -> Trace:
    rows = [s for s in summaries if s["metric"] == metric.key and s.method == method]
    places = [x.factor * row["value"] for row in rows]
    ends = ("lower_quartile", "median", "upper_quartile")
    return Trace.of(
        run, method, places, [Quartiles(*map(row.__getitem__, ends)) for row in rows], metric
    )


def _metrics(kind: SweepKind, run: Run) -> tuple[Metric, ...]:
    times = (metrics.MICROSECONDS,) if kind.is_timed else ()
    return (*times, *ERRORS, *run.metrics)


def _held(kind: SweepKind) -> str:
    """The quantities that are held."""
    noise = "" if kind.column == "noise_px" else f"noise {kind.noise_px:g} px, "
    return noise if kind.column == "points" else f"{noise}{kind.points} points, "


_CHUNK, _CHUNK_TIMED = 64, 20


def plan(options: SweepOptions, folder: RunFolder) -> Plan[SweepTask]:
    """Plan a sweep."""
    kind = options.kind
    benchmark = sweep_benchmark(kind, options.seed, options.metrics)
    config = {
        "experiment": options.experiment,
        "seed": options.seed,
        "sweep": asdict(kind),
        **benchmark.config,
    }
    chunk = _CHUNK_TIMED if kind.is_timed else _CHUNK
    return Plan(benchmark, sweep_tasks(kind), config, chunk)


def _describe(run: Run) -> str:
    kind = kind_of(run)
    problems = f"{kind.runs:,} problems for each value"
    return f"on the AEPnP paper's simulation, {kind.name} varied, {problems}"


SPEC = Spec(
    options=SweepOptions,
    plan=plan,
    columns=(metrics.INSTANCES, metrics.FAILED, *ERRORS, metrics.MICROSECONDS),
    results=COLUMNS,
    summarize=summarize,
    lines=lines,
    table=console_table,
    group=varied,
    plots=plots,
    kind=lambda run: f"cadalign simulate {kind_of(run).name}",
    title=lambda runs: f"simulation: {kind_of(runs[0]).name}",
    describe=_describe,
    note="Medians over the problems that did not fail.",
)
