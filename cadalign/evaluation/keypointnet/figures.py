"""Figures of a KeypointNet run: medians per category, and cumulative curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.evaluation.accuracy.style import label_log_axis, look_of, new_figure, save_figure
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.outcome import OK, SKIPPED
from cadalign.evaluation.plots import in_math
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.summary import Summary

_BARS = (metrics.ROTATION, metrics.TRANSLATION, metrics.SCALE_Y, metrics.SCALE_Z)
_CURVES = (metrics.SYM_ROTATION, metrics.SYM_TRANSLATION, metrics.SCALE_Y)


def draw_figures(run: Run, summaries: Sequence[Summary]) -> None:
    """Draw all figures of a run, PNG and PDF."""
    folder = run.folder.made_figures()
    for metric in _BARS:
        _draw_categories(folder / f"categories_{metric.key}", summaries, metric)
    for metric in _CURVES:
        _draw_curves(folder / f"within_{metric.key}", run, metric)


def _draw_categories(path: Path, summaries: Sequence[Summary], metric: Metric) -> None:
    """Draw a metric's medians, a column of points for each category."""
    categories = list(dict.fromkeys(summary.group for summary in summaries))
    places = np.arange(len(categories))
    with new_figure(figsize=(max(6.4, 0.62 * len(categories) + 2), 4.2)) as figure:
        axes = figure.add_subplot()
        for method in dict.fromkeys(summary.method for summary in summaries):
            look = look_of(method)
            found = {s.group: s[metric.key] for s in summaries if s.method == method}
            heights = metric.factor * np.array([found.get(name, np.nan) for name in categories])
            if look.marker:
                axes.plot(places, heights, look.marker, color=look.color, label=look.label)
            else:  # the Cramer-Rao bound: a floor beneath each category
                axes.hlines(
                    heights,
                    places - 0.35,
                    places + 0.35,
                    color=look.color,
                    linestyle=look.dash,
                    lw=1.4,
                    label=look.label,
                )
        axes.set_yscale("log")
        label_log_axis(axes)
        axes.set_xticks(range(len(categories)), categories)
        axes.tick_params(axis="x", labelrotation=45 if len(categories) > 7 else 0)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(f"median {in_math(metric.axis)}")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        save_figure(figure, path)


def _draw_curves(path: Path, run: Run, metric: Metric) -> None:
    """Draw the share of instances within an error, for each method."""
    cells = run.cells
    errors = metric.factor * cells[metric.key].astype(float)
    with new_figure(figsize=(6.4, 4.2)) as figure:
        axes = figure.add_subplot()
        for method in run.methods:
            chosen = (cells["method"] == method) & (cells["status"] != SKIPPED)
            values: FloatArray = np.sort(errors[chosen & (cells["status"] == OK)])
            share = 100 * np.arange(1, len(values) + 1) / max(int(chosen.sum()), 1)
            look = look_of(method)
            axes.plot(values, share, color=look.color, linestyle=look.dash, label=look.label)
        axes.set_xlim(0, metric.limit)
        axes.set_ylim(0, 100)
        axes.set_xlabel(in_math(metric.axis))
        axes.set_ylabel("instances with at most this error [%]")
        axes.legend(loc="lower right")
        save_figure(figure, path)
