"""Plots of a run on photos: errors as cumulative curves by method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cadalign.evaluation.curves import cumulative
from cadalign.evaluation.metrics.kitti import DEPTH, IOU_3D
from cadalign.evaluation.metrics.pascal3d import ROTATION
from cadalign.evaluation.metrics.table import BOX_IOU
from cadalign.evaluation.plots import Plot
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.summary import known

_CURVES = (
    (ROTATION, np.array([0.2, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 45, 90])),
    (replace(DEPTH, log=False), np.array([1, 2, 3, 5, 7.5, 10, 15, 20, 30])),
    (replace(BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
    (replace(IOU_3D, log=False), np.arange(0, 1.01, 0.05)),
)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Shares of objects within an error, for the errors that the data sets have."""
    return [
        cumulative(runs, metric, places, title=f"{metric.label} on photos")
        for metric, places in _CURVES
        if any(len(known(run.cells[metric.key])) for run in runs)
    ]
