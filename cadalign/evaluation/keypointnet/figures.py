"""What is made of a KeypointNet run's results: a summary, and figures over all categories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cadalign.arrays import FloatArray
from cadalign.errors import DataError
from cadalign.evaluation.accuracy.outcome import OK
from cadalign.evaluation.accuracy.style import (
    METRIC_LABELS,
    PERCENT_METRICS,
    label_log_axis,
    look_of,
    new_figure,
    save_figure,
)
from cadalign.evaluation.accuracy.summary import (
    ALL,
    MEDIANS,
    CategorySummary,
    summarize_cells,
    summary_csv,
)
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.files import write_text, writing

_BAR_METRICS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")
_CURVE_METRICS = ("sym_rotation_error_deg", "sym_translation_error", "scale_y_error")
_CURVE_LIMITS = {
    "sym_rotation_error_deg": 20.0,
    "sym_translation_error": 0.2,
    "scale_y_error": 20.0,
}
_CELLS = ("method", "status", "keypoints", *MEDIANS)


def write_keypointnet_report(folder: RunFolder) -> list[CategorySummary]:
    """Write ``summary.csv`` and ``figures`` of a finished run.

    Raises
    ------
    DataError
        If the results cannot be read or the files cannot be written.
    """
    summaries = summarize_run(folder.results)
    write_text(folder.summary, summary_csv(summaries))
    with writing(folder.figures):
        folder.figures.mkdir(exist_ok=True)
    for metric in _BAR_METRICS:
        draw_categories(folder.figures / f"categories_{metric}", summaries, metric)
    _draw_curves(folder)
    return summaries


def summarize_run(results: Path) -> list[CategorySummary]:
    """A summary for every category and method, and for all categories together."""
    summaries = []
    for category in (*_categories(results), None):
        table = _read(results, _CELLS, category)
        cells = {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
        summaries += summarize_cells(ALL if category is None else category, cells)
    return summaries


def draw_categories(path: Path, summaries: list[CategorySummary], metric: str) -> list[Path]:
    """Draw a metric's medians, a column of points for each category, PNG and PDF.

    Parameters
    ----------
    path : Path
        Without an ending.
    summaries : list of CategorySummary
    metric : str
        The name of one of their medians.
    """
    categories = list(dict.fromkeys(summary.category for summary in summaries))
    methods = list(dict.fromkeys(summary.method for summary in summaries))
    percent = 100 if metric in PERCENT_METRICS else 1
    with new_figure(figsize=(max(6.4, 0.62 * len(categories) + 2), 4.2)) as figure:
        axes = figure.add_subplot()
        for method in methods:
            look = look_of(method)
            found = {s.category: getattr(s, metric) for s in summaries if s.method == method}
            heights = percent * np.array([found.get(name, np.nan) for name in categories])
            places = np.arange(len(categories))
            if look.marker:
                axes.plot(places, heights, look.marker, color=look.color, label=look.label)
            else:  # the limit: a floor beneath each category
                left, right = places - 0.35, places + 0.35
                axes.hlines(
                    heights,
                    left,
                    right,
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
        axes.set_ylabel(f"median {METRIC_LABELS[metric]}")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return save_figure(figure, path)


def _draw_curves(folder: RunFolder) -> None:
    """Draw how many instances lie within an error, for each method."""
    for metric in _CURVE_METRICS:
        table = _read(folder.results, ("method", "status", metric), None)
        methods = table["method"].to_numpy(zero_copy_only=False)
        errors = table[metric].to_numpy(zero_copy_only=False).astype(float)
        solved = table["status"].to_numpy(zero_copy_only=False) == OK
        percent = 100 if metric in PERCENT_METRICS else 1
        with new_figure(figsize=(6.4, 4.2)) as figure:
            axes = figure.add_subplot()
            for method in dict.fromkeys(methods.tolist()):
                chosen = methods == method
                values: FloatArray = np.sort(percent * errors[chosen & solved])
                share = 100 * np.arange(1, len(values) + 1) / max(int(chosen.sum()), 1)
                look = look_of(method)
                axes.plot(values, share, color=look.color, linestyle=look.dash, label=look.label)
            plain = metric.removeprefix("sym_")
            aware = ", symmetries allowed for" if plain != metric else ""
            axes.set_xlim(0, _CURVE_LIMITS[metric])
            axes.set_ylim(0, 100)
            axes.set_xlabel(METRIC_LABELS[plain] + aware)
            axes.set_ylabel("instances with at most this error [%]")
            axes.legend(loc="lower right")
            save_figure(figure, folder.figures / f"within_{metric}")


def _categories(results: Path) -> list[str]:
    return sorted(pc.unique(_read(results, ("category",), None)["category"]).to_pylist())


def _read(results: Path, columns: tuple[str, ...], category: str | None) -> pa.Table:
    """Columns of a result table, of one category or of all."""
    filters = None if category is None else [("category", "==", category)]
    try:
        return pq.read_table(results, columns=list(columns), filters=filters, use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise DataError(
            f"not a table that can be read ({error})",
            where=str(results),
            fix="remove it and start the same run again",
        ) from None
