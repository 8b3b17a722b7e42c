"""Success rates and quartiles of methods for every share of outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.outcome import OK
from cadalign.evaluation.plots import QUARTILES_NOTE, Plot, Trace
from cadalign.evaluation.runs.opened import Cells, Run
from cadalign.evaluation.summary import (
    Conclusion,
    ConsoleTable,
    Line,
    Quartiles,
    flat,
    group_name,
    median_of,
)

ERRORS = (metrics.ROTATION, metrics.TRANSLATION_OF_DISTANCE, metrics.SCALE_Y, metrics.SCALE_Z)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.SUCCESS, *ERRORS),
    *(metrics.INLIER_RECALL, metrics.MILLISECONDS),
)
SUCCESS_NOTE = "success: rotation within 0.5 deg and both scales within 1 %"


@dataclass(frozen=True)
class CorrespondenceSummary:
    """Numbers of one method at one share of outliers.

    Quartiles are over all inputs, a failure counting as an error beyond all others.

    Parameters
    ----------
    outliers : float
        Share of the image points that were moved.
    method : str
    inputs : int
        Number of inputs that it was given.
    failed : int
        Number of those for which it found nothing.
    unreadable : int
        Number of inputs that there would be besides if all images could be read.
    success : float
        Share of the inputs with a rotation error of less than 0.5 degrees and at most 1 % on either
        scale; NaN where there are none.
    rotation_error_deg, translation_error, scale_y_error, scale_z_error : Quartiles
        [degrees] and fractions; the translation's of the distance from the camera to the mean of
        the points.
    inlier_precision, inlier_recall : float
        Medians over what it found; NaN for methods that do not search for inliers.
    milliseconds : Quartiles
        Time of one call, failed ones too.
    """

    outliers: float
    method: str
    inputs: int
    failed: int
    unreadable: int
    success: float
    rotation_error_deg: Quartiles
    translation_error: Quartiles
    scale_y_error: Quartiles
    scale_z_error: Quartiles
    inlier_precision: float
    inlier_recall: float
    milliseconds: Quartiles

    def cells(self) -> dict[str, Any]:
        """All numbers by name, flat."""
        return flat(self)


def summarize(run: Run) -> list[CorrespondenceSummary]:
    """A summary for every share of outliers and method, in the order of the run."""
    cells = run.cells
    return [
        _summarize(share, method, cells)
        for share in np.unique(cells["outliers"]).tolist()
        for method in run.methods
    ]


def lines(summaries: Sequence[CorrespondenceSummary]) -> list[Line]:
    """Lines of the headline table."""
    return [
        Line(
            group_name(metrics.OUTLIERS, s.outliers),
            s.method,
            {
                name: value.median if isinstance(value, Quartiles) else value
                for name, value in {**vars(s), "instances": s.inputs}.items()
            },
        )
        for s in summaries
    ]


def console_table(run: Run, summaries: Sequence[CorrespondenceSummary]) -> ConsoleTable:
    """Quartiles of the errors, and medians, for the console."""
    failed = replace(metrics.FAILED, symbol="fail")
    shown = (failed, metrics.SUCCESS, *ERRORS, metrics.INLIER_RECALL)
    return ConsoleTable(
        title="Lower quartile, median and upper quartile per share of outliers and method",
        labels=(metrics.OUTLIERS.symbol, "method"),
        heads=(*(metric.symbol for metric in shown), metrics.MILLISECONDS.symbol),
        rows=[
            (
                f"{100 * s.outliers:g} %",
                s.method,
                failed.text(s.failed),
                metrics.SUCCESS.text(s.success),
                *(_three(getattr(s, metric.key), metric) for metric in ERRORS),
                _number(100 * s.inlier_recall, digits=1),
                _number(s.milliseconds.median, digits=1),
            )
            for s in summaries
        ],
        note=(
            f"{max(summary.inputs for summary in summaries)} inputs each; a failure counts as an "
            "error beyond all others (-).\n"
            "succ: R < 0.5 deg and both scales within 1 %; t: % of the camera's distance from the "
            "mean of the points;\nfound: share of the inliers that were kept (median); ms: median."
        ),
        narrow=True,
    )


def conclude(run: Run, summaries: Sequence[CorrespondenceSummary]) -> Conclusion:
    """Numbers of rows, of failures, and of inputs whose image cannot be read."""
    unreadable = sum(summary.unreadable for summary in summaries)
    rows = sum(summary.inputs for summary in summaries) + unreadable
    failed = sum(summary.failed for summary in summaries) + unreadable
    note = f"{unreadable} of them because their image cannot be read" if unreadable else ""
    return Conclusion(rows, failed, {"unreadable": unreadable}, note)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Success, errors and times against the share of outliers."""
    found = [summarize(run) for run in runs]
    inputs = max((summary.inputs for summary in found[0]), default=0)
    made = []
    for metric in (metrics.SUCCESS, *ERRORS, metrics.MILLISECONDS):
        note = f"{QUARTILES_NOTE}; failures count as infinite"
        if metric is metrics.MILLISECONDS:
            note = QUARTILES_NOTE
        elif metric is metrics.SUCCESS:
            note = ""
        traces = []
        for index, summaries in enumerate(found):
            for method in runs[index].methods:
                rows = [summary for summary in summaries if summary.method == method]
                x = [100 * summary.outliers for summary in rows]
                y = [getattr(summary, metric.key) for summary in rows]
                traces.append(Trace.of(index, method, x, y, metric))
        caption = f"{inputs} inputs each; {note or SUCCESS_NOTE}"
        figure = f"outliers_{metric.key}"
        made.append(Plot(metric.key, metrics.OUTLIERS, metric, traces, note, caption, figure))
    return made


def _summarize(share: float, method: str, cells: Cells) -> CorrespondenceSummary:
    chosen = (cells["outliers"] == share) & (cells["method"] == method)
    # No points were given where the image cannot be read.
    given = chosen & ~np.isnan(cells["points"].astype(float))
    solved = given & (cells["status"] == OK)
    inputs = int(given.sum())
    quartiles = {}
    for metric in ERRORS:
        errors = np.full(inputs, np.inf)
        errors[solved[given]] = cells[metric.key][solved].astype(float)
        quartiles[metric.key] = Quartiles.of(errors)
    return CorrespondenceSummary(
        outliers=share,
        method=method,
        inputs=inputs,
        failed=inputs - int(solved.sum()),
        unreadable=int(chosen.sum()) - inputs,
        success=float(cells["success"][given].astype(float).mean()) if inputs else np.nan,
        inlier_precision=median_of(cells["inlier_precision"][solved]),
        inlier_recall=median_of(cells["inlier_recall"][solved]),
        milliseconds=Quartiles.of(1e3 * cells["seconds"][given]),
        **quartiles,
    )


def _three(values: Quartiles, metric: Metric) -> str:
    quartiles = (values.lower, values.median, values.upper)
    return " ".join(_number(metric.factor * value, digits=metric.digits) for value in quartiles)


def _number(value: float, *, digits: int) -> str:
    """A number with so many digits after the point, fewer for larger ones; a dash for NaN."""
    if value != value:
        return "-"
    if value >= 1e4:
        return f"{value:.0e}"
    places = max(0, digits + 1 - len(str(int(value))))
    return f"{value:.{places}f}"
