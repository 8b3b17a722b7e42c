"""Cumulative curves of errors by method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cadalign.arrays import FloatArray
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.table import HIGH, Metric
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.plots import Plot, Trace
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.summary import known

_SHARE = replace(metrics.COVERED, key="share", label="objects", better=HIGH)


def cumulative(runs: Sequence[Run], metric: Metric, places: FloatArray, *, title: str) -> Plot:
    """Shares of the objects with at most an error, or at least an overlap, by method.

    Parameters
    ----------
    runs : sequence of Run
    metric : Metric
        Column of the result tables; failures count as never within.
    places : (k,) float
        The errors, in the column's unit.
    title : str
    """
    traces = []
    for index, run in enumerate(runs):
        for method in run.methods:
            chosen = run.cells["method"] == method
            solved = chosen & (run.cells["status"] == OK)
            errors = known(run.cells[metric.key][solved])
            count = max(int(chosen.sum()), 1)
            within = (
                errors >= places[:, None] if metric.better == HIGH else errors <= places[:, None]
            )
            shares = within.sum(axis=1) / count
            traces.append(Trace.of(index, method, places.tolist(), shares.tolist(), _SHARE))
    words = "at least this overlap" if metric.better == HIGH else "at most this error"
    return Plot(
        id=f"within_{metric.key}",
        x=metric,
        y=replace(_SHARE, label=f"objects with {words}"),
        traces=traces,
        note="over all categories; failures count",
        title=title,
    )
