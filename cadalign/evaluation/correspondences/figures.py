"""What is made of a correspondence run's results: a table of quartiles, and figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

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
from cadalign.io.files import write_text, writing

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes

ERRORS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")
TIME = "milliseconds"
_LABELS = {
    "rotation_error_deg": METRIC_LABELS["rotation_error_deg"],
    "translation_error": "translation error [% of the distance]",
    "scale_y_error": METRIC_LABELS["scale_y_error"],
    "scale_z_error": METRIC_LABELS["scale_z_error"],
    TIME: "time of one call [ms]",
}
_PERCENT = (*PERCENT_METRICS, "translation_error")
# Of lines and markers [points].
_THINNEST, _SMALLEST, _STEP = 1.5, 4.5, 0.35
_Cells = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Quartiles:
    """Quartiles over all inputs, a failure counting as an error beyond all others.

    NaN where so many failed that the quartile is a failure: whoever gives up on the hard inputs
    does not look better for it.

    Parameters
    ----------
    lower, median, upper : float
    """

    lower: float
    median: float
    upper: float

    @classmethod
    def of(cls, values: FloatArray) -> Quartiles:
        """Quartiles of values (n,), infinite ones being failures.

        Examples
        --------
        >>> Quartiles.of(np.array([3.0, 1.0, 2.0, np.inf]))
        Quartiles(lower=1.0, median=2.0, upper=3.0)
        >>> Quartiles.of(np.array([1.0, np.inf, np.inf]))
        Quartiles(lower=1.0, median=nan, upper=nan)
        """
        if not len(values):
            return cls(np.nan, np.nan, np.nan)
        # Order statistics: interpolation would reckon with infinities.
        found = np.percentile(values, [25, 50, 75], method="inverted_cdf")
        return cls(*np.where(np.isfinite(found), found, np.nan).tolist())


@dataclass(frozen=True)
class CorrespondenceSummary:
    """What one method did at one share of outliers.

    Parameters
    ----------
    outliers : float
        Share of the image points that were moved.
    method : str
    inputs : int
        How many it was given.
    failed : int
        For how many of them it found nothing.
    unreadable : int
        How many more inputs there would be if all images could be read.
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

    def quartiles(self, metric: str) -> Quartiles:
        """The quartiles of one of `ERRORS`, or of `TIME`."""
        found = getattr(self, metric)
        assert isinstance(found, Quartiles)
        return found

    def cells(self) -> dict[str, Any]:
        """All numbers by name, flat; empty instead of NaN."""
        cells: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Quartiles):
                cells[f"{name}_lower_quartile"] = value.lower
                cells[f"{name}_median"] = value.median
                cells[f"{name}_upper_quartile"] = value.upper
            else:
                cells[name] = value
        return {name: "" if value != value else value for name, value in cells.items()}


def write_correspondences_report(folder: RunFolder) -> list[CorrespondenceSummary]:
    """Write ``summary.csv`` and ``figures`` of a finished run.

    Raises
    ------
    DataError
        If the results cannot be read or the files cannot be written.
    """
    summaries = summarize_correspondences(folder)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(summaries[0].cells()), lineterminator="\n")
    writer.writeheader()
    writer.writerows(summary.cells() for summary in summaries)
    write_text(folder.summary, text.getvalue())
    with writing(folder.figures):
        folder.figures.mkdir(exist_ok=True)
    for metric in (*ERRORS, TIME):
        draw_quartiles(folder.figures / f"outliers_{metric}", summaries, metric)
    draw_success(folder.figures / "outliers_success", summaries)
    return summaries


def summarize_correspondences(folder: RunFolder) -> list[CorrespondenceSummary]:
    """A summary for every share of outliers and method, in the order of the run."""
    return summarize_correspondence_tables(
        read_table(folder.results), read_table(folder.timings, columns=["seconds"])
    )


def summarize_correspondence_tables(
    results: pa.Table, timings: pa.Table
) -> list[CorrespondenceSummary]:
    """The same of its tables, which may be those of an unfinished run."""
    cells = {name: results[name].to_numpy(zero_copy_only=False) for name in results.column_names}
    cells[TIME] = 1e3 * timings["seconds"].to_numpy(zero_copy_only=False).astype(float)
    methods = list(dict.fromkeys(cells["method"].tolist()))
    return [
        _summarize(share, method, cells)
        for share in np.unique(cells["outliers"]).tolist()
        for method in methods
    ]


def draw_quartiles(
    path: Path, summaries: Sequence[CorrespondenceSummary], metric: str
) -> list[Path]:
    """Draw medians against the share of outliers as lines, quartiles as bands; PNG and PDF.

    A line ends where more than half of the inputs failed.

    Parameters
    ----------
    path : Path
        Without an ending.
    summaries : sequence of CorrespondenceSummary
    metric : str
        One of `ERRORS`, or `TIME`.
    """
    percent = 100 if metric in _PERCENT else 1
    bands = []
    with new_figure(figsize=(6.4, 4.2)) as figure:
        axes = figure.add_subplot()
        for method, options in _drawn(summaries):
            rows = [row for row in summaries if row.method == method]
            quartiles = [row.quartiles(metric) for row in rows]
            x = 100 * np.array([row.outliers for row in rows])
            low, middle, high = (
                percent * np.array([getattr(q, name) for q in quartiles])
                for name in ("lower", "median", "upper")
            )
            axes.plot(x, middle, **options)
            axes.plot(x, low, x, high, alpha=0)  # make room for the band
            bands.append((x, low, high, options["color"]))
        axes.set_yscale("log")
        bottom, top = axes.get_ylim()
        for x, low, high, color in bands:
            # Where an upper quartile is a failure, the band has no upper end.
            above = np.where(np.isnan(high) & ~np.isnan(low), top, high)
            axes.fill_between(x, low, above, color=color, alpha=0.14, linewidth=0)
        axes.set_ylim(bottom, top)
        label_log_axis(axes)
        note = "line: median, band: quartiles"
        if metric != TIME:
            note += "; failures count as infinite"
        _finish(axes, summaries, _LABELS[metric], note)
        return save_figure(figure, path)


def draw_success(path: Path, summaries: Sequence[CorrespondenceSummary]) -> list[Path]:
    """Draw success rates against the share of outliers, PNG and PDF; see `draw_quartiles`."""
    with new_figure(figsize=(6.4, 4.2)) as figure:
        axes = figure.add_subplot()
        for method, options in _drawn(summaries):
            rows = [row for row in summaries if row.method == method]
            x = [100 * row.outliers for row in rows]
            axes.plot(x, [100 * row.success for row in rows], **options)
        axes.set_ylim(-3, 103)
        note = "success: rotation within 0.5 deg and both scales within 1 %"
        _finish(axes, summaries, "success [%]", note)
        return save_figure(figure, path)


def _finish(axes: Axes, summaries: Sequence[CorrespondenceSummary], label: str, note: str) -> None:
    """What the figures share: axes, title and, beside the lines, the legend."""
    axes.set_xticks(sorted({round(100 * row.outliers, 6) for row in summaries}))
    axes.set_xlabel("outliers [%]")
    axes.set_ylabel(label)
    inputs = max(row.inputs for row in summaries)
    axes.set_title(f"{inputs} inputs each; {note}", fontsize=9, color="0.35", loc="left")
    axes.figure.legend(loc="outside lower center", ncols=2)


def _drawn(summaries: Sequence[CorrespondenceSummary]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each method with the options of its line, thinner ones last: they often coincide."""
    methods = list(dict.fromkeys(summary.method for summary in summaries))
    for place, method in enumerate(methods):
        look = look_of(method)
        below = len(methods) - 1 - place
        yield (
            method,
            {
                "color": look.color,
                "linestyle": look.dash,
                "marker": look.marker,
                "label": look.label,
                "linewidth": _THINNEST + _STEP * below,
                "markersize": _SMALLEST + 2 * _STEP * below,
            },
        )


def _summarize(share: float, method: str, cells: _Cells) -> CorrespondenceSummary:
    chosen = (cells["outliers"] == share) & (cells["method"] == method)
    given = chosen & _is_given(cells)
    solved = given & (cells["status"] == OK)
    inputs = int(given.sum())
    quartiles = {}
    for name in ERRORS:
        errors = np.full(inputs, np.inf)
        errors[solved[given]] = cells[name][solved].astype(float)
        quartiles[name] = Quartiles.of(errors)
    return CorrespondenceSummary(
        outliers=share,
        method=method,
        inputs=inputs,
        failed=inputs - int(solved.sum()),
        unreadable=int(chosen.sum()) - inputs,
        success=float(cells["success"][given].astype(float).mean()) if inputs else np.nan,
        inlier_precision=_median(cells["inlier_precision"][solved]),
        inlier_recall=_median(cells["inlier_recall"][solved]),
        milliseconds=Quartiles.of(cells[TIME][given]),
        **quartiles,
    )


def _is_given(cells: _Cells) -> npt.NDArray[np.bool_]:
    """Whether there was an input: not so where the image cannot be read."""
    return np.asarray(~np.isnan(cells["points"].astype(float)))


def _median(values: npt.NDArray[Any]) -> float:
    """The median of values (n,), some of which may be missing; NaN if there are none."""
    known = values.astype(float)
    known = known[~np.isnan(known)]
    return float(np.median(known)) if len(known) else np.nan
