"""Plots of a run on evidence: errors as cumulative curves by evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cadalign.evaluation.curves import cumulative
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.plots import Plot
from cadalign.evaluation.runs.opened import Run

_CURVES = (
    (metrics.ROTATION, np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1, 1.5, 2, 3, 5, 10])),
    (replace(metrics.BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Shares of objects within an error, by evidence."""
    return [
        cumulative(runs, metric, places, title=f"{metric.label} by evidence")
        for metric, places in _CURVES
    ]
