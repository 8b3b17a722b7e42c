"""The headline and the lines of retrieval runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from cadalign.report.headline import (
    COUNTS,
    Column,
    Headline,
    HeadlineRow,
    failures_of,
    headline_row,
    with_best,
)
from cadalign.report.instances import compact
from cadalign.report.looks import HIGH
from cadalign.report.runs import Run

if TYPE_CHECKING:
    from cadalign.evaluation.retrieval.figures import RetrievalSummary

_COLUMNS = (
    *COUNTS,
    Column("rank_1", "true model first", "%", digits=1, better=HIGH, factor=100),
    Column("rank_5", "among the first 5", "%", digits=1, better=HIGH, factor=100),
    Column("reciprocal_rank", "mean reciprocal rank", digits=3, better=HIGH),
    Column("shape_distance", "shape distance", "%", factor=100),
    Column("box_iou", "box IoU", digits=3, better=HIGH),
    Column("rotation_error_deg", "R error", "deg"),
    Column("milliseconds", "time of a query", "ms", digits=1),
)
_NOTE = (
    "Leave-in: the library holds the true model; models whose keypoints are the same after stretch "
    "count as it. Leave-out: it and these are taken out. Shape distance, box IoU, rotation error "
    "and time are medians, the first three of the best match."
)
_Value = Callable[["RetrievalSummary"], float]
# Key, label, unit, protocol.
_LINES: tuple[tuple[str, str, str, str, _Value], ...] = (
    ("rank_1", "true model first", "%", "leave-in", lambda s: 100 * s.rank_1),
    ("rank_5", "true model among the first 5", "%", "leave-in", lambda s: 100 * s.rank_5),
    ("box_iou", "median box IoU", "", "leave-out", lambda s: s.box_iou),
    ("shape_distance", "median shape distance", "%", "leave-out", lambda s: 100 * s.shape_distance),
)


def retrieval_headline(runs: Sequence[Run]) -> Headline:
    """The headline table: a group for each category, protocol, noise and number of keypoints."""
    rows: list[HeadlineRow] = []
    failures = []
    for index, run in enumerate(runs):
        groups: dict[str, list[RetrievalSummary]] = {}
        for summary in _summaries(run):
            if summary.queries:
                groups.setdefault(_group(summary), []).append(summary)
        found = [
            headline_row(index, group, summary.method, _values(summary), _COLUMNS)
            for group, summaries in groups.items()
            for summary in summaries
        ]
        rows += with_best(found, _COLUMNS)
        failures += failures_of(index, run.results, "category")
    return Headline("queries", _COLUMNS, rows, failures, note=_NOTE)


def retrieval_plots(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Rates against the number of keypoints, over all categories, a plot for each noise."""
    from cadalign.evaluation.retrieval.figures import ALL

    found = [[s for s in _summaries(run) if s.category == ALL and s.queries] for run in runs]
    plots = []
    for key, label, unit, protocol, value in _LINES:
        chosen = [[s for s in summaries if s.protocol == protocol] for summaries in found]
        for noise in sorted({s.noise_px for summaries in chosen for s in summaries}):
            traces = []
            for index, summaries in enumerate(chosen):
                for method in dict.fromkeys(s.method for s in summaries):
                    line = [s for s in summaries if s.method == method and s.noise_px == noise]
                    traces.append(
                        {
                            "run": index,
                            "method": method,
                            "x": [summary.keypoints for summary in line],
                            "y": compact([value(summary) for summary in line]),
                        }
                    )
            plots.append(
                {
                    "id": f"{key}_{noise:g}",
                    "title": f"{label[0].upper()}{label[1:]}, {noise:g} px of noise, {protocol}",
                    "kind": "lines",
                    "x": {"label": "keypoints in the image", "unit": "", "log": False},
                    "y": {"label": label, "unit": unit, "log": False},
                    "traces": traces,
                    "note": "over all categories",
                }
            )
    return plots


def _summaries(run: Run) -> list[RetrievalSummary]:
    from cadalign.evaluation.retrieval.figures import summarize_retrieval_tables

    return summarize_retrieval_tables(run.results, run.timings)


def _group(summary: RetrievalSummary) -> str:
    view = f"{summary.noise_px:g} px, {summary.keypoints} keypoints"
    return f"{summary.category}, {summary.protocol}, {view}"


def _values(summary: RetrievalSummary) -> dict[str, Any]:
    return {**vars(summary), "instances": summary.queries}
