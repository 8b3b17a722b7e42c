"""Specification of the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from cadalign.evaluation import metrics
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.simulation.experiment import (
    ERRORS,
    SweepExperiment,
    SweepTask,
    SweepTasks,
)
from cadalign.evaluation.simulation.options import SweepOptions
from cadalign.evaluation.simulation.summary import (
    console_table,
    kind_of,
    lines,
    plots,
    summarize,
    varied,
)
from cadalign.evaluation.spec import Spec

_CHUNK, _CHUNK_TIMED = 64, 20


def plan(options: SweepOptions, folder: RunFolder) -> Plan[SweepTask]:
    """Plan a sweep."""
    kind = options.kind
    return Plan(
        SweepExperiment(kind, options.seed),
        SweepTasks(kind.values, kind.runs),
        {"experiment": options.experiment, "seed": options.seed, "sweep": asdict(kind)},
        _CHUNK_TIMED if kind.is_timed else _CHUNK,
    )


def _title(runs: Sequence[Run]) -> str:
    return f"simulation: {kind_of(runs[0]).name}"


def _describe(run: Run) -> str:
    kind = kind_of(run)
    problems = f"{kind.runs:,} problems for each value"
    return f"on the AEPnP paper's simulation, {kind.name} varied, {problems}"


SPEC = Spec(
    options=SweepOptions,
    plan=plan,
    columns=(metrics.INSTANCES, metrics.FAILED, *ERRORS, metrics.MICROSECONDS),
    summarize=summarize,
    lines=lines,
    table=console_table,
    group=varied,
    plots=plots,
    kind=lambda run: f"cadalign simulate {kind_of(run).name}",
    title=_title,
    describe=_describe,
    note="Medians over the problems that did not fail.",
)
