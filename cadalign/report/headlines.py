"""What stands in the headline of each family of runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cadalign.evaluation.accuracy.summary import ALL, summarize_cells
from cadalign.evaluation.correspondences.figures import (
    ERRORS,
    CorrespondenceSummary,
    summarize_correspondence_tables,
)
from cadalign.evaluation.simulation.experiment import SWEEP_METRICS, SweepKind
from cadalign.evaluation.simulation.figures import (
    TIME_METRIC,
    VALUE_LABELS,
    SweepSummary,
    summarize_sweep_tables,
)
from cadalign.report.headline import (
    COUNTS,
    Column,
    Headline,
    HeadlineRow,
    failures_of,
    headline_row,
    varied,
    with_best,
)
from cadalign.report.looks import HIGH
from cadalign.report.retrieval import retrieval_headline
from cadalign.report.runs import CORRESPONDENCES, INSTANCES, RETRIEVAL, Run

_INSTANCE_COLUMNS = (
    *COUNTS,
    Column("keypoints", "keypoints", digits=1, better=None),
    Column("rotation_error_deg", "R error", "deg", digits=3),
    Column("translation_error", "t error", "diagonals", digits=4),
    Column("scale_y_error", "s_y error", "%", factor=100),
    Column("scale_z_error", "s_z error", "%", factor=100),
    Column("box_iou", "box IoU", digits=3, better=HIGH),
    Column("sym_rotation_error_deg", "R error, sym.", "deg", digits=3),
    Column("success_5deg_5pct", "within 5 deg, 5 %", "%", digits=1, better=HIGH, factor=100),
    Column("success_10deg_10pct", "within 10 deg, 10 %", "%", digits=1, better=HIGH, factor=100),
    Column("over_limit", "R error over limit", better=None),
)
_ERROR_COLUMNS = (
    Column("rotation_error_deg", "R error", "deg", digits=3),
    Column("translation_error", "t error", "model units", digits=4),
    Column("scale_y_error", "s_y error", "%", factor=100),
    Column("scale_z_error", "s_z error", "%", factor=100),
)
_SWEEP_COLUMNS = (*COUNTS, *_ERROR_COLUMNS)
_TIME_COLUMN = Column(TIME_METRIC, "time of one call", "µs", digits=1)
_CORRESPONDENCE_COLUMNS = (
    *COUNTS,
    Column("success", "success", "%", digits=1, better=HIGH, factor=100),
    _ERROR_COLUMNS[0],
    Column("translation_error", "t error", "% of distance", factor=100),
    *_ERROR_COLUMNS[2:],
    Column("inlier_recall", "right points kept", "%", digits=1, better=HIGH, factor=100),
    Column("milliseconds", "time of one call", "ms", digits=2),
)
_INSTANCE_NOTE = (
    "Medians over the instances that did not fail; the rates count failures. The symmetry-aware "
    "error (sym.) takes rotations that map a model onto itself for right. A rate counts instances "
    "whose symmetry-aware rotation, translation in diagonals of the model and both scales are that "
    "good."
)
_SWEEP_NOTE = "Medians over the problems that did not fail."
_CORRESPONDENCE_NOTE = (
    "Medians; a failure counts as an error beyond all others. Success: rotation within 0.5 deg and "
    "both scales within 1 %."
)


def headline_of(runs: Sequence[Run]) -> Headline:
    """The headline table of runs of one family."""
    if runs[0].family == INSTANCES:
        return _of_instances(runs)
    if runs[0].family == CORRESPONDENCES:
        return _of_correspondences(runs)
    if runs[0].family == RETRIEVAL:
        return retrieval_headline(runs)
    return _of_simulations(runs)


def sweep_kind(run: Run) -> SweepKind:
    """The sweep that a simulation's run made."""
    given = run.config["sweep"]
    return SweepKind(
        **{**given, "values": tuple(given["values"]), "methods": tuple(given["methods"])}
    )


def sweep_summaries(run: Run) -> list[SweepSummary]:
    """Quartiles of a simulation's run, as far as it is."""
    found = summarize_sweep_tables(run.results, run.timings, sweep_kind(run))
    return [summary for summary in found if summary.runs]


def correspondence_summaries(run: Run) -> list[CorrespondenceSummary]:
    """Summaries of a correspondences run, as far as it is."""
    return summarize_correspondence_tables(run.results, run.timings)


def _of_instances(runs: Sequence[Run]) -> Headline:
    rows, failures = [], []
    for index, run in enumerate(runs):
        cells = {
            name: run.results[name].to_numpy(zero_copy_only=False)
            for name in run.results.column_names
        }
        names = sorted(set(cells["category"].tolist()))
        summaries = []
        for name in names:
            chosen = cells["category"] == name
            some = {key: column[chosen] for key, column in cells.items()}
            summaries += summarize_cells(name, some)
        if len(names) > 1:
            summaries += summarize_cells(ALL, cells)
        found = [
            headline_row(index, s.category, s.method, vars(s), _INSTANCE_COLUMNS) for s in summaries
        ]
        rows += with_best(found, _INSTANCE_COLUMNS)
        failures += failures_of(index, run.results, "category")
    paper, note = _stated(runs, {row.category for row in rows})
    return Headline(
        "category", _INSTANCE_COLUMNS, rows, failures, paper, f"{_INSTANCE_NOTE} {note}".strip()
    )


def _stated(runs: Sequence[Run], categories: set[str]) -> tuple[list[HeadlineRow], str]:
    """The paper's rows on these categories, and what is to be said of them."""
    if 1.0 not in {run.noise_px for run in runs}:  # all that the paper's table is about
        return [], ""
    from cadalign.evaluation.paper.reproduction import PAPER_TABLE, PERCENT_NOTE

    rows = [
        headline_row(0, name, "AEPnP, stated in the paper", vars(stated), _INSTANCE_COLUMNS)
        for name, stated in PAPER_TABLE.items()
        if name in categories
    ]
    return rows, f"{PERCENT_NOTE} Its models and views are others." if rows else ""


def _of_simulations(runs: Sequence[Run]) -> Headline:
    kind = sweep_kind(runs[0])
    columns = (*_SWEEP_COLUMNS, _TIME_COLUMN) if kind.is_timed else _SWEEP_COLUMNS
    rows, failures = [], []
    for index, run in enumerate(runs):
        cells: dict[tuple[float, str], dict[str, Any]] = {}
        for summary in sweep_summaries(run):
            row = cells.setdefault((summary.value, summary.method), {})
            row[summary.metric] = summary.median
            if summary.metric == SWEEP_METRICS[0]:
                row.update(instances=summary.runs, failed=summary.failed)
        found = [
            headline_row(index, varied(kind.column, value), method, cells[value, method], columns)
            for value, method in sorted(cells, key=lambda key: key[0])
        ]
        rows += with_best(found, columns)
        failures += failures_of(index, run.results, kind.column)
    return Headline(VALUE_LABELS[kind.column], columns, rows, failures, note=_SWEEP_NOTE)


def _of_correspondences(runs: Sequence[Run]) -> Headline:
    rows, failures = [], []
    for index, run in enumerate(runs):
        found = []
        for summary in correspondence_summaries(run):
            values = {name: getattr(summary, name) for name in ("failed", "success")}
            values["instances"] = summary.inputs
            values["inlier_recall"] = summary.inlier_recall
            for name in (*ERRORS, "milliseconds"):
                values[name] = summary.quartiles(name).median
            group = varied("outliers", summary.outliers)
            found.append(
                headline_row(index, group, summary.method, values, _CORRESPONDENCE_COLUMNS)
            )
        rows += with_best(found, _CORRESPONDENCE_COLUMNS)
        failures += failures_of(index, run.results, "outliers")
    return Headline(
        "outliers [%]", _CORRESPONDENCE_COLUMNS, rows, failures, note=_CORRESPONDENCE_NOTE
    )
