"""What is made of a sweep's results: a table of quartiles, and a figure for each metric."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.evaluation.accuracy.outcome import OK
from cadalign.evaluation.accuracy.style import (
    METRIC_LABELS,
    PERCENT_METRICS,
    label_log_axis,
    look_of,
    new_figure,
    save_figure,
)
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_table
from cadalign.evaluation.simulation.experiment import SWEEP_METRICS, SweepKind
from cadalign.io.files import write_text, writing

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes

TIME_METRIC = "microseconds"
VALUE_LABELS = {
    "noise_px": "noise of the keypoints [px]",
    "points": "number of points",
    "outlier_share": "outliers [%]",
}


@dataclass(frozen=True)
class SweepSummary:
    """Quartiles of one metric, over the problems that a method solved at one value.

    Parameters
    ----------
    value : float
        What is varied.
    method, metric : str
    runs, failed : int
        How many problems, and how many of them the method did not solve.
    lower_quartile, median, upper_quartile : float
        NaN where it solved none.
    """

    value: float
    method: str
    metric: str
    runs: int
    failed: int
    lower_quartile: float
    median: float
    upper_quartile: float


def summarize_sweep(folder: RunFolder, kind: SweepKind) -> list[SweepSummary]:
    """Quartiles of a finished run, for every metric, method and value."""
    return summarize_sweep_tables(
        read_table(folder.results), read_table(folder.timings, columns=["seconds"]), kind
    )


def summarize_sweep_tables(
    results: pa.Table, timings: pa.Table, kind: SweepKind
) -> list[SweepSummary]:
    """The same of its tables, which may be those of an unfinished run."""
    cells = {name: results[name].to_numpy(zero_copy_only=False) for name in results.column_names}
    metrics: tuple[str, ...] = SWEEP_METRICS
    if kind.is_timed:
        cells[TIME_METRIC] = 1e6 * timings["seconds"].to_numpy(zero_copy_only=False).astype(float)
        metrics = (TIME_METRIC, *metrics)
    summaries = []
    for metric in metrics:
        for method in kind.methods:
            for value in kind.values:
                chosen = (cells["method"] == method) & (cells[kind.column] == value)
                solved = chosen & (cells["status"] == OK)
                quartiles = _quartiles(cells[metric][solved].astype(float))
                count, failed = int(chosen.sum()), int((chosen & ~solved).sum())
                summaries.append(SweepSummary(value, method, metric, count, failed, *quartiles))
    return summaries


def write_sweep_report(folder: RunFolder, kind: SweepKind) -> list[SweepSummary]:
    """Write ``summary.csv`` and ``figures`` of a finished run.

    Raises
    ------
    DataError
        If the results cannot be read or the files cannot be written.
    """
    summaries = summarize_sweep(folder, kind)
    names = [field.name for field in fields(SweepSummary)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([kind.column if name == "value" else name for name in names])
    for summary in summaries:
        values = [getattr(summary, name) for name in names]
        writer.writerow(["" if value != value else value for value in values])
    write_text(folder.summary, text.getvalue())
    with writing(folder.figures):
        folder.figures.mkdir(exist_ok=True)
    for metric in dict.fromkeys(summary.metric for summary in summaries):
        some = [summary for summary in summaries if summary.metric == metric]
        draw_sweep(folder.figures / f"{kind.name}_{metric}", kind, some)
    return summaries


def draw_sweep(path: Path, kind: SweepKind, summaries: list[SweepSummary]) -> list[Path]:
    """Draw medians as lines and quartiles as bands, PNG and PDF.

    Parameters
    ----------
    path : Path
        Without an ending.
    kind : SweepKind
    summaries : list of SweepSummary
        Of one metric.
    """
    metric = summaries[0].metric
    with new_figure(figsize=(6.4, 4.2)) as figure:
        axes = figure.add_subplot()
        for method in kind.methods:
            rows = [row for row in summaries if row.method == method]
            _draw_method(axes, kind, method, rows)
        axes.set_yscale("log")
        if kind.column == "points":
            axes.set_xscale("log")
            axes.set_xticks(kind.values, [f"{value:g}" for value in kind.values])
            axes.minorticks_off()
            axes.tick_params(axis="x", labelrotation=45 if len(kind.values) > 9 else 0)
        label_log_axis(axes)
        axes.set_xlabel(VALUE_LABELS[kind.column])
        axes.set_ylabel(METRIC_LABELS[metric])
        axes.set_title(_held(kind, summaries), fontsize=9, color="0.35", loc="left")
        axes.legend(loc="best")
        return save_figure(figure, path)


def _draw_method(axes: Axes, kind: SweepKind, method: str, rows: list[SweepSummary]) -> None:
    look = look_of(method)
    percent = 100 if rows and rows[0].metric in PERCENT_METRICS else 1
    x = np.array([row.value for row in rows]) * (100 if kind.column == "outlier_share" else 1)
    low, middle, high = (
        percent * np.array([getattr(row, name) for row in rows])
        for name in ("lower_quartile", "median", "upper_quartile")
    )
    if not np.isfinite(middle).any():
        return
    options: Any = {"color": look.color, "linestyle": look.dash, "marker": look.marker}
    axes.plot(x, middle, label=look.label, zorder=3 if look.marker else 4, **options)
    if look.marker:  # the limit is a floor, and its band would only hide the others
        axes.fill_between(x, low, high, color=look.color, alpha=0.14, linewidth=0)


def _held(kind: SweepKind, summaries: list[SweepSummary]) -> str:
    """What is held, for a figure's title."""
    held = [f"{summaries[0].runs} problems each; line: median, band: quartiles"]
    if kind.column != "points":
        held.insert(0, f"{kind.points} points")
    if kind.column != "noise_px":
        held.insert(0, f"noise {kind.noise_px:g} px")
    return ", ".join(held)


def _quartiles(values: FloatArray) -> tuple[float, float, float]:
    values = values[np.isfinite(values)]
    if not len(values):
        return np.nan, np.nan, np.nan
    low, middle, high = np.percentile(values, [25, 50, 75]).tolist()
    return low, middle, high
