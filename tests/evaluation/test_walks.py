"""Files that a new metric of photos touches: one, with a line of a set."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics import photos as metrics
from cadalign.evaluation.metrics.photos import score_alignment, score_columns, statistics_of
from cadalign.evaluation.summary import Group


def test_columns_scores_and_summaries_follow_from_the_line_of_a_metric() -> None:
    """A function of one's own is a metric, too: see `test_metrics`."""
    depth = Metric("depth_off", "depth error", "m")
    extended = replace(
        metrics.VIEWPOINT,
        measure=lambda target, est, gt, box: {depth.key: abs(float((est - gt).sum()))},
        medians=(*metrics.VIEWPOINT.medians, depth),
    )
    assert score_columns([extended])[-1] == (depth.key, float)
    target: Any = SimpleNamespace(gt=np.array([0.0, 0.0, 2.0]))
    ests: list[Any] = [target.gt + [0, 0, off] for off in (0.25, 0.5, 2.0)]
    box: Any = None
    rows = [score_alignment(target, [extended], est, box) for est in ests]
    cells = {depth.key: np.array([row[depth.key] for row in rows])}
    found = statistics_of([extended], cells | {metrics.ROTATION.key: np.full(3, np.nan)})
    assert found[depth.key](Group(cells, cells)) == 0.5
