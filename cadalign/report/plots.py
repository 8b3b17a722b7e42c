"""Lines of simulations and correspondence runs, with quartiles, as their figures have them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from cadalign.evaluation.correspondences.figures import ERRORS, TIME, Quartiles
from cadalign.evaluation.simulation.experiment import SWEEP_METRICS
from cadalign.evaluation.simulation.figures import TIME_METRIC, VALUE_LABELS
from cadalign.report.headlines import correspondence_summaries, sweep_kind, sweep_summaries
from cadalign.report.instances import compact
from cadalign.report.retrieval import retrieval_plots
from cadalign.report.runs import CORRESPONDENCES, RETRIEVAL, SIMULATION, Run

_AXES = {
    "rotation_error_deg": ("rotation error", "deg", 1.0),
    "translation_error": ("translation error", "model units", 1.0),
    "scale_y_error": ("error of s_y", "%", 100.0),
    "scale_z_error": ("error of s_z", "%", 100.0),
    TIME_METRIC: ("time of one call", "µs", 1.0),
    TIME: ("time of one call", "ms", 1.0),
    "success": ("success", "%", 100.0),
}
_QUARTILES = "line: median, band: quartiles"


def line_plots(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The plots of runs that have no instances to show; none for those that have."""
    if runs[0].family == SIMULATION:
        return _simulation_plots(runs)
    if runs[0].family == RETRIEVAL:
        return retrieval_plots(runs)
    return _correspondence_plots(runs) if runs[0].family == CORRESPONDENCES else []


def _simulation_plots(runs: Sequence[Run]) -> list[dict[str, Any]]:
    kind = sweep_kind(runs[0])
    found = [sweep_summaries(run) for run in runs]
    share = 100.0 if kind.column == "outlier_share" else 1.0
    plots = []
    for metric in (TIME_METRIC, *SWEEP_METRICS) if kind.is_timed else SWEEP_METRICS:
        traces = []
        for index, summaries in enumerate(found):
            for method in sweep_kind(runs[index]).methods:
                rows = [s for s in summaries if s.metric == metric and s.method == method]
                quartiles = [Quartiles(s.lower_quartile, s.median, s.upper_quartile) for s in rows]
                x = [share * summary.value for summary in rows]
                traces.append(_trace(index, method, x, quartiles, _AXES[metric][2]))
        label, _, unit = VALUE_LABELS[kind.column].partition(" [")
        x_axis = {"label": label, "unit": unit.rstrip("]"), "log": kind.column == "points"}
        plots.append(_plot(metric, x_axis, traces, note=_QUARTILES))
    return plots


def _correspondence_plots(runs: Sequence[Run]) -> list[dict[str, Any]]:
    found = [correspondence_summaries(run) for run in runs]
    x_axis = {"label": "outliers", "unit": "%", "log": False}
    plots = []
    for metric in ("success", *ERRORS, TIME):
        traces = []
        for index, summaries in enumerate(found):
            for method in dict.fromkeys(summary.method for summary in summaries):
                rows = [summary for summary in summaries if summary.method == method]
                x = [100 * summary.outliers for summary in rows]
                if metric == "success":
                    rates = [Quartiles(s.success, s.success, s.success) for s in rows]
                    trace = _trace(index, method, x, rates, 100.0)
                    del trace["low"], trace["high"]
                else:
                    quartiles = [summary.quartiles(metric) for summary in rows]
                    factor = 100.0 if metric == "translation_error" else _AXES[metric][2]
                    trace = _trace(index, method, x, quartiles, factor)
                traces.append(trace)
        note = _QUARTILES if metric == TIME else f"{_QUARTILES}; failures count as infinite"
        plots.append(_plot(metric, x_axis, traces, note="" if metric == "success" else note))
    for plot in plots:
        if plot["id"] == "translation_error":
            plot["y"]["unit"] = "% of distance"
    return plots


def _plot(
    metric: str, x_axis: dict[str, Any], traces: Iterable[dict[str, Any]], *, note: str
) -> dict[str, Any]:
    label, unit, _ = _AXES[metric]
    return {
        "id": metric,
        "title": f"{label[0].upper()}{label[1:]} against {x_axis['label']}",
        "kind": "lines",
        "x": x_axis,
        "y": {"label": label, "unit": unit, "log": metric != "success"},
        "traces": list(traces),
        "note": note,
    }


def _trace(
    run: int, method: str, x: Sequence[float], quartiles: Sequence[Quartiles], factor: float
) -> dict[str, Any]:
    return {
        "run": run,
        "method": method,
        "x": list(x),
        "y": compact([factor * quartile.median for quartile in quartiles]),
        "low": compact([factor * quartile.lower for quartile in quartiles]),
        "high": compact([factor * quartile.upper for quartile in quartiles]),
    }
