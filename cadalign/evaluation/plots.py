"""Figures of runs: medians against a quantity, and cumulative curves, one line per method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.evaluation import metrics
from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.metrics import HIGH, Metric
from cadalign.evaluation.runs.work import FAILED, OK
from cadalign.evaluation.summary import Summary, drop_nan, select_rows
from cadalign.io.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.evaluation.runs.tables import Cells, Run

# Colours for all kinds of colour vision: Okabe and Ito's (jfly.uni-koeln.de/color), then dark ones
# of Paul Tol's "muted" (personal.sron.nl/~pault).
COLORS = (
    *("#0072B2", "#E69F00", "#D55E00", "#CC79A7", "#009E73", "#56B4E9"),
    *("#332288", "#999933", "#882255", "#44AA99", "#AA4499", "#117733"),
)
"""Colours of lines, in order."""


def color_of(method: str, place: int) -> str:
    """The colour of a method by its index; black for the Cramer-Rao bound."""
    return "black" if method == LIMIT else COLORS[place % len(COLORS)]


STYLE: dict[Any, Any] = {
    "axes.grid": True,
    "grid.color": "0.9",
    "pdf.fonttype": 42,  # TrueType, which publishers ask for
    "figure.dpi": 160,
}
"""Matplotlib settings of all figures."""

_DIGITS = 6


@dataclass(frozen=True)
class Trace:
    """A line of a plot, in the units of its axes.

    ``run`` is the index of the run among the compared ones. Missing values are None.
    """

    run: int
    method: str
    x: list[float]
    y: list[float | None]

    @classmethod
    def from_values(
        cls, run: int, method: str, x: Sequence[float], y: Sequence[float], unit: Metric
    ) -> Trace:
        """Make a line of values, which are converted to the metric's unit."""
        return cls(run, method, list(x), compact([unit.shown(value) for value in y]))


@dataclass(frozen=True)
class Plot:
    """A plot of lines, with a note on its numbers; the default title names its axes."""

    id: str
    x: Metric
    y: Metric
    traces: list[Trace]
    note: str = ""
    title: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The plot for a page."""
        axes = {
            name: {key: axis.page()[key] for key in ("label", "unit", "log")}
            for name, axis in (("x", self.x), ("y", self.y))
        }
        title = self.title or f"{self.y.label} against {self.x.label}"
        return {
            "id": self.id,
            "title": f"{title[0].upper()}{title[1:]}",
            **axes,
            "traces": [vars(trace) for trace in self.traces],
            "note": self.note,
        }


def plot_against(found: Sequence[Sequence[Summary]], x: Metric, y: Metric, *, note: str) -> Plot:
    """Plot ``y`` against ``x``, two columns of summaries, by run and method."""
    traces = []
    for index, summaries in enumerate(found):
        for method in dict.fromkeys(each.method for each in summaries):
            rows = [each for each in summaries if each.method == method]
            places = [x.factor * each[x.key] for each in rows]
            values = [each[y.key] for each in rows]
            traces.append(Trace.from_values(index, method, places, values, y))
    return Plot(y.key, x, y, traces, note)


def compact(values: npt.ArrayLike | Sequence[float | None]) -> list[float | None]:
    """Round numbers to 6 digits; None for numbers that are not finite."""
    numbers = np.asarray(values, dtype=float).tolist()
    return [float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None for value in numbers]


def draw_plot(path: Path, plot: Plot) -> list[Path]:
    """Draw a plot as PNG and PDF; ``path`` has no suffix. Returns the files."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    files = [path.with_name(f"{path.name}.{ending}") for ending in ("png", "pdf")]
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.8), layout="constrained")
        scales = {f"{name}scale": "log" for name in ("x", "y") if getattr(plot, name).log}
        axes = figure.add_subplot(xlabel=plot.x.axis, ylabel=plot.y.axis, **scales)
        axes.set_title(plot.note, fontsize=9, color="0.35", loc="left")
        _draw_lines(axes, plot)
        figure.legend(loc="outside lower center", ncols=2, handlelength=3.6)
        for file in files:
            # Without date or software, files are reproducible.
            metadata: Any = {"CreationDate": None} if file.suffix == ".pdf" else {"Software": None}
            write_whole(file, partial(figure.savefig, metadata=metadata))
            figure.set_layout_engine("none")  # keep the layout of the first file
    return files


def _draw_lines(axes: Axes, plot: Plot) -> None:
    """Draw lines, which break at missing values."""
    methods = list(dict.fromkeys(trace.method for trace in plot.traces))
    for trace in plot.traces:
        place, is_limit = methods.index(trace.method), trace.method == LIMIT
        color = color_of(trace.method, place)
        axes.plot(
            trace.x,
            np.array(trace.y, dtype=float),
            color=color,
            linestyle="--" if is_limit else "-",
            marker="" if is_limit else "o",
            label=trace.method,
        )


def cumulative_plot(runs: Sequence[Run], metric: Metric, places: FloatArray, *, title: str) -> Plot:
    """Plot the share of objects with at most an error, or at least an overlap, by method.

    ``metric`` is a column of the result tables. Failures count as misses; rows that were left out,
    skipped or have no value do not count. ``places`` (k,) are values of the metric on the x axis.
    """
    is_within = np.greater_equal if metric.better == HIGH else np.less_equal
    words = "at least this overlap" if metric.better == HIGH else "at most this error"

    def shares(rows: Cells) -> FloatArray:
        errors = drop_nan(rows[metric.key][rows["status"] == OK])
        count = len(errors) + int((rows["status"] == FAILED).sum())
        return np.asarray(is_within(errors, places[:, None]).sum(axis=1) / max(count, 1))

    shown = (metric.factor * places).tolist()
    traces = [
        Trace.from_values(index, method, shown, shares(rows).tolist(), metrics.COVERED)
        for index, run in enumerate(runs)
        for method in run.methods
        for rows in [select_rows(run.cells, run.cells["method"] == method)]
    ]
    return Plot(
        id=f"within_{metric.key}",
        x=metric,
        y=replace(metrics.COVERED, key="share", label=f"objects with {words}", better=HIGH),
        traces=traces,
        note="over all categories; failures count",
        title=title,
    )


def cumulative_curves(
    runs: Sequence[Run], *, curves: Sequence[tuple[Metric, FloatArray]], of: str
) -> list[Plot]:
    """Cumulative plots of the metrics that some run has; see `cumulative_plot`."""
    return [
        cumulative_plot(runs, metric, places, title=f"{metric.label} {of}")
        for metric, places in curves
        if any(len(drop_nan(run.cells[metric.key])) for run in runs)
    ]
