"""Plots of a run on unseen objects: errors as cumulative curves, and calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cadalign.evaluation.curves import cumulative
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.plots import Plot, Trace
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.summary import known

_CURVES = (
    (metrics.ROTATION, np.array([0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30])),
    (replace(metrics.BOX_IOU_UP_TO_SCALE, log=False), np.arange(0, 1.01, 0.1)),
)
_LEVELS = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.68, 0.8, 0.9, 0.95, 0.99])
_CALIBRATED = (("rotation_level", "rotation"), ("stretch_level", "stretch"))


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Shares of objects within an error, and of truths within stated regions, by method."""
    curves = [
        cumulative(runs, metric, places, title=f"{metric.label} of unseen objects")
        for metric, places in _CURVES
    ]
    return [*curves, *(_calibration(runs, column, name) for column, name in _CALIBRATED)]


def _calibration(runs: Sequence[Run], column: str, name: str) -> Plot:
    traces = []
    for index, run in enumerate(runs):
        for method in run.methods:
            levels = known(run.cells[column][run.cells["method"] == method])
            if len(levels):
                shares = (levels <= _LEVELS[:, None]).mean(axis=1)
                places = (100 * _LEVELS).tolist()
                traces.append(Trace.of(index, method, places, shares.tolist(), metrics.COVERED))
    return Plot(
        id=f"calibration_{name}",
        x=metrics.NOMINAL,
        y=metrics.COVERED,
        traces=traces,
        note="over all categories; deviations are right where both are equal",
        title=f"Calibration of the {name}",
    )
