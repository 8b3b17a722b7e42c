"""Rates of retrieval by category, protocol, noise and number of keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.plots import Plot, Trace
from cadalign.evaluation.retrieval.experiment import NO_VIEW
from cadalign.evaluation.retrieval.options import LEAVE_IN, LEAVE_OUT
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import ALL, ConsoleTable, Line, mean_of, median_of

HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.RANK_1, metrics.RANK_5, metrics.RECIPROCAL_RANK),
    *(metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.MATCH_ROTATION),
    metrics.QUERY_MILLISECONDS,
)
_KEYPOINTS = replace(metrics.KEYPOINTS, label="keypoints in the image", log=False)
_PLOTS = (
    (metrics.RANK_1, LEAVE_IN),
    (metrics.RANK_5, LEAVE_IN),
    (replace(metrics.BOX_IOU, label="median box IoU"), LEAVE_OUT),
    (replace(metrics.SHAPE_DISTANCE, label="median shape distance"), LEAVE_OUT),
)


@dataclass(frozen=True)
class RetrievalSummary:
    """Numbers of one method on one category's queries of one kind.

    Parameters
    ----------
    category, protocol, method : str
    noise_px : float
        [px]
    keypoints : int
        Number that was handed over.
    queries : int
        Number that was made; models without a view that shows enough keypoints are not counted.
    failed : int
        Number of these that gave no match.
    rank_1, rank_5 : float
        Share of the queries with the true model, or one that counts as it, first, or among the
        first 5; NaN in the leave-out protocol.
    reciprocal_rank : float
        Mean of one over the rank, 0 beyond 50; NaN in the leave-out protocol.
    score : float
        Mean probability of the best match: where it is calibrated, that is the rank-1 rate.
    shape_distance, box_iou, rotation_error_deg : float
        Medians of the best match: keypoints' distance after stretch, as a share of their extent;
        box IoU; rotation error [degrees].
    mean_box_iou : float
    milliseconds : float
        Median time of a query on one core.
    """

    category: str
    protocol: str
    method: str
    noise_px: float
    keypoints: int
    queries: int
    failed: int
    rank_1: float
    rank_5: float
    reciprocal_rank: float
    score: float
    shape_distance: float
    box_iou: float
    mean_box_iou: float
    rotation_error_deg: float
    milliseconds: float

    def cells(self) -> dict[str, Any]:
        """All numbers by name."""
        return asdict(self)

    @property
    def group(self) -> str:
        """Category, protocol, noise and number of keypoints."""
        view = f"{self.noise_px:g} px, {self.keypoints} keypoints"
        return f"{self.category}, {self.protocol}, {view}"


def summarize(run: Run) -> list[RetrievalSummary]:
    """A summary for every category, protocol, method, noise and number of keypoints."""
    cells = run.cells
    categories = sorted(set(cells["category"].tolist()))
    groups = [*categories, ALL] if len(categories) > 1 else [ALL]
    return [
        _summarize(cells, category, protocol, method, noise, keypoints)
        for category in groups
        for protocol in dict.fromkeys(cells["protocol"].tolist())
        for method in run.methods
        for noise in np.unique(cells["noise_px"]).tolist()
        for keypoints in np.unique(cells["keypoints"]).tolist()
    ]


def lines(summaries: Sequence[RetrievalSummary]) -> list[Line]:
    """Lines of the headline table, those of a group together."""
    groups: dict[str, list[Line]] = {}
    for s in summaries:
        if s.queries:
            values = {**vars(s), "instances": s.queries}
            groups.setdefault(s.group, []).append(Line(s.group, s.method, values))
    return [line for found in groups.values() for line in found]


def console_table(run: Run, summaries: Sequence[RetrievalSummary]) -> ConsoleTable:
    """Rates and medians over all categories for the console."""
    shown = (
        *(metrics.RANK_1, metrics.RANK_5, metrics.RECIPROCAL_RANK, metrics.SCORE),
        *(metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.MATCH_ROTATION),
        metrics.QUERY_MILLISECONDS,
    )
    return ConsoleTable(
        title="Rates over the queries, medians of the best match",
        labels=("protocol", "method"),
        heads=("px", metrics.KEYPOINTS.symbol, "n", *(metric.symbol for metric in shown)),
        rows=[
            (
                s.protocol,
                s.method,
                *(f"{s.noise_px:g}", str(s.keypoints), str(s.queries)),
                *(metric.text(getattr(s, metric.key)) for metric in shown),
            )
            for s in summaries
            if s.category == ALL
        ],
        narrow=True,
        grouped=False,
    )


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Rates and medians against the number of keypoints, over all categories, for each noise."""
    found = [[s for s in summarize(run) if s.category == ALL and s.queries] for run in runs]
    return [
        _plot(metric, protocol, noise, found)
        for metric, protocol in _PLOTS
        for noise in sorted({s.noise_px for summaries in found for s in summaries})
        if any(s.protocol == protocol and s.noise_px == noise for ss in found for s in ss)
    ]


def _plot(
    metric: Metric, protocol: str, noise: float, found: Sequence[Sequence[RetrievalSummary]]
) -> Plot:
    chosen = [
        [s for s in summaries if s.protocol == protocol and s.noise_px == noise]
        for summaries in found
    ]
    traces = []
    for index, summaries in enumerate(chosen):
        for method in dict.fromkeys(s.method for s in summaries):
            rows = [s for s in summaries if s.method == method]
            y = [getattr(s, metric.key) for s in rows]
            traces.append(Trace.of(index, method, [s.keypoints for s in rows], y, metric))
    queries = sorted({s.queries for summaries in chosen for s in summaries})
    count = f"{queries[0]:,} to {queries[-1]:,}" if len(queries) > 1 else f"{queries[0]:,}"
    return Plot(
        id=f"{metric.key}_{noise:g}",
        x=_KEYPOINTS,
        y=metric,
        traces=traces,
        note="over all categories",
        caption=f"{protocol}; {metric.axis}; {count} queries each",
        figure=f"{protocol.replace('-', '_')}_{metric.key}",
        variant=f"{noise:g} px",
        title=f"{metric.label}, {noise:g} px of noise, {protocol}",
    )


def _summarize(
    cells: Cells, category: str, protocol: str, method: str, noise: float, keypoints: int
) -> RetrievalSummary:
    chosen = (
        (cells["protocol"] == protocol)
        & (cells["method"] == method)
        & (cells["noise_px"] == noise)
        & (cells["keypoints"] == keypoints)
    )
    if category != ALL:
        chosen &= cells["category"] == category
    solved = chosen & (cells["status"] == OK)
    made = chosen & (cells["status"] != NO_VIEW)
    queries = int(made.sum())
    ranks = cells["rank"][made].astype(float)  # NaN beyond 50
    ranked = queries and protocol == LEAVE_IN
    return RetrievalSummary(
        category=category,
        protocol=protocol,
        method=method,
        noise_px=noise,
        keypoints=keypoints,
        queries=queries,
        failed=queries - int(solved.sum()),
        rank_1=float((ranks == 1).mean()) if ranked else np.nan,
        rank_5=float((ranks <= 5).mean()) if ranked else np.nan,
        reciprocal_rank=float(np.nan_to_num(1 / ranks).mean()) if ranked else np.nan,
        score=mean_of(cells["score"][solved]),
        shape_distance=median_of(cells["shape_distance"][solved]),
        box_iou=median_of(cells["box_iou"][solved]),
        mean_box_iou=mean_of(cells["box_iou"][solved]),
        rotation_error_deg=median_of(cells["rotation_error_deg"][solved]),
        milliseconds=median_of(1e3 * cells["seconds"][solved]),
    )
