"""Specification of the simulation."""

from __future__ import annotations

from dataclasses import asdict

from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.simulation import experiment, summary
from cadalign.evaluation.simulation.options import SweepOptions
from cadalign.evaluation.simulation.summary import kind_of
from cadalign.evaluation.spec import Spec

_CHUNK, _CHUNK_TIMED = 64, 20


def plan(options: SweepOptions, folder: RunFolder) -> Plan[experiment.SweepTask]:
    """Plan a sweep."""
    kind = options.kind
    benchmark = experiment.sweep_benchmark(kind, options.seed, options.metrics)
    config = {
        "experiment": options.experiment,
        "seed": options.seed,
        "sweep": asdict(kind),
        **benchmark.config,
    }
    chunk = _CHUNK_TIMED if kind.is_timed else _CHUNK
    return Plan(benchmark, experiment.sweep_tasks(kind), config, chunk)


def _describe(run: Run) -> str:
    kind = kind_of(run)
    problems = f"{kind.runs:,} problems for each value"
    return f"on the AEPnP paper's simulation, {kind.name} varied, {problems}"


SPEC = Spec(
    options=SweepOptions,
    plan=plan,
    columns=(metrics.INSTANCES, metrics.FAILED, *experiment.ERRORS, metrics.MICROSECONDS),
    results=experiment.COLUMNS,
    summarize=summary.summarize,
    lines=summary.lines,
    table=summary.console_table,
    group=summary.varied,
    plots=summary.plots,
    kind=lambda run: f"cadalign simulate {kind_of(run).name}",
    title=lambda runs: f"simulation: {kind_of(runs[0]).name}",
    describe=_describe,
    note="Medians over the problems that did not fail.",
)
