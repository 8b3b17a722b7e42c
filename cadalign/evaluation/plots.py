"""Figures of runs: lines with quartile bands, and curves of shares, a colour for each method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
from cadalign.evaluation.summary import Quartiles, Summary, known, where
from cadalign.io.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from cadalign.evaluation.runs.tables import Cells, Run

# Colours that colour-blind people tell apart, too: Okabe and Ito's (jfly.uni-koeln.de/color), then
# dark ones of Paul Tol's "muted" (personal.sron.nl/~pault).
COLORS = (
    *("#0072B2", "#E69F00", "#D55E00", "#CC79A7", "#009E73", "#56B4E9"),
    *("#332288", "#999933", "#882255", "#44AA99", "#AA4499", "#117733"),
)
"""Colours of lines, in their order."""
_MARKERS = "os^DvP<X>phd"


def color_of(method: str, place: int) -> str:
    """The colour of a method by its place; that of the Cramer-Rao bound is black."""
    return "black" if method == LIMIT else COLORS[place % len(COLORS)]


STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.grid": True,
    "axes.grid.which": "both",
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "pdf.fonttype": 42,  # TrueType, which publishers ask for
    "figure.dpi": 160,
}
"""Settings of matplotlib that all figures share."""


@contextmanager
def new_figure(**options: Any) -> Iterator[Figure]:
    """A figure in the project's style, drawn without a display."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        yield Figure(layout="constrained", **options)


def save_figure(figure: Figure, path: Path) -> list[Path]:
    """Write a figure as PNG and PDF, ``path`` being without an ending; returns the files."""
    files = [path.with_name(f"{path.name}.{ending}") for ending in ("png", "pdf")]
    for file in files:
        # Without its date a PDF is the same in every run.
        metadata: Any = {"CreationDate": None} if file.suffix == ".pdf" else {"Software": None}
        write_whole(file, partial(figure.savefig, metadata=metadata))
        figure.set_layout_engine("none")  # the first file's is the second's
    return files


QUARTILES_NOTE = "line: median, band: quartiles"
_DIGITS = 6
_MOST_TICKS = 30


@dataclass(frozen=True)
class Trace:
    """A line of a plot, in the units of its axes, with the ends of a band if it has one.

    ``run`` is the place of the run among those that are compared. Values are None where there is
    none.
    """

    run: int
    method: str
    x: list[float]
    y: list[float | None]
    low: list[float | None] | None = None
    high: list[float | None] | None = None

    @classmethod
    def of(
        cls, run: int, method: str, x: Sequence[float], y: Sequence[float | Quartiles], unit: Metric
    ) -> Trace:
        """A line through values, or through medians with quartiles as its band."""
        quartiles = [q for q in y if isinstance(q, Quartiles)]
        if not quartiles:
            return cls(run, method, list(x), compact([unit.shown(value) for value in y]))
        middle, low, high = (
            compact([unit.shown(getattr(q, name)) for q in quartiles])
            for name in ("median", "lower", "upper")
        )
        return cls(run, method, list(x), middle, low, high)

    def to_dict(self) -> dict[str, Any]:
        """The line for the page."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Plot:
    """A plot of lines, by default titled after its axes, with a note on its numbers."""

    id: str
    x: Metric
    y: Metric
    traces: list[Trace]
    note: str = ""
    title: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The plot for the page."""
        axes = {
            name: {key: axis.page()[key] for key in ("label", "unit", "log")}
            for name, axis in (("x", self.x), ("y", self.y))
        }
        title = self.title or f"{self.y.label} against {self.x.label}"
        return {
            "id": self.id,
            "title": f"{title[0].upper()}{title[1:]}",
            **axes,
            "traces": [trace.to_dict() for trace in self.traces],
            "note": self.note,
        }


def plot_against(
    found: Sequence[Sequence[Summary]], x: Metric, y: Metric, *, place: str, **words: str
) -> Plot:
    """Lines of a number against what runs vary, the cell ``place`` of their summaries, by method.

    ``words`` are further fields of the plot.
    """
    traces = []
    for index, summaries in enumerate(found):
        for method in dict.fromkeys(each.method for each in summaries):
            rows = [each for each in summaries if each.method == method]
            places = [x.factor * each[place] for each in rows]
            traces.append(Trace.of(index, method, places, [each[y.key] for each in rows], y))
    return Plot(**{"id": y.key, **words}, x=x, y=y, traces=traces)


def compact(values: npt.ArrayLike | Sequence[float | None]) -> list[float | None]:
    """Numbers with 6 digits; None for what is not finite."""
    numbers = np.asarray(values, dtype=float).tolist()
    return [float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None for value in numbers]


def draw_plot(path: Path, plot: Plot) -> list[Path]:
    """Draw a plot into a file, PNG and PDF; ``path`` has no ending.

    A line ends where there is no value, and a band without an upper end goes to the top.
    """
    x, y = plot.x, plot.y
    with new_figure(figsize=(6.4, 4.2 + 0.12 * max(0, len(plot.traces) - 6))) as figure:
        axes = figure.add_subplot()
        bands = _draw_lines(axes, plot)
        if y.log:
            axes.set_yscale("log")
        elif y.unit == "%":
            axes.set_ylim(-3, max(103, axes.get_ylim()[1]))
        bottom, top = axes.get_ylim()
        for places, low, high, color in bands:
            above = np.where(np.isnan(high) & ~np.isnan(low), top, high)
            axes.fill_between(places, low, above, color=color, alpha=0.14, linewidth=0)
        axes.set_ylim(bottom, top)
        ticks = sorted({round(value, 6) for trace in plot.traces for value in trace.x})
        if x.log:
            axes.set_xscale("log")
        if len(ticks) <= _MOST_TICKS:
            axes.set_xticks(ticks, [f"{value:g}" for value in ticks])
            axes.minorticks_off()
            axes.tick_params(axis="x", labelrotation=45 if len(ticks) > 9 else 0)
        if y.log:
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlabel(x.axis)
        axes.set_ylabel(y.axis)
        axes.set_title(plot.note, fontsize=9, color="0.35", loc="left")
        figure.legend(loc="outside lower center", ncols=2, handlelength=3.6)
        return save_figure(figure, path)


def _draw_lines(axes: Axes, plot: Plot) -> list[tuple[Any, Any, Any, str]]:
    """Draw lines; returns their bands."""
    bands = []
    methods = list(dict.fromkeys(trace.method for trace in plot.traces))
    for trace in plot.traces:
        place, is_limit = methods.index(trace.method), trace.method == LIMIT
        color = color_of(trace.method, place)
        has_markers = not is_limit and len(trace.x) <= _MOST_TICKS
        middle = np.array(trace.y, dtype=float)
        if not np.isfinite(middle).any():
            continue
        axes.plot(
            trace.x,
            middle,
            color=color,
            linestyle="--" if is_limit else "-",
            marker=_MARKERS[place % len(_MARKERS)] if has_markers else "",
            label=trace.method,
        )
        # The Cramer-Rao bound is a floor whose band would hide the others.
        if trace.low is not None and trace.high is not None and not is_limit:
            low, high = (np.array(end, dtype=float) for end in (trace.low, trace.high))
            axes.plot(trace.x, low, trace.x, high, alpha=0)  # make room for the band
            bands.append((trace.x, low, high, color))
    return bands


def share_traces(
    runs: Sequence[Run], places: FloatArray, shares: Callable[[Cells], FloatArray | None]
) -> list[Trace]:
    """Lines of shares of a method's rows at places (k,) of the axis; None where there is no row."""
    return [
        Trace.of(index, method, places.tolist(), found.tolist(), metrics.COVERED)
        for index, run in enumerate(runs)
        for method in run.methods
        if (found := shares(where(run.cells, run.cells["method"] == method))) is not None
    ]


def cumulative(runs: Sequence[Run], metric: Metric, places: FloatArray, *, title: str) -> Plot:
    """Shares of the objects with at most an error, or at least an overlap, by method.

    ``metric`` is a column of the result tables, of which failures count as never within, while rows
    that were left out, skipped or have no value do not count; ``places`` (k,) are the errors, in
    the column's unit.
    """
    is_within = np.greater_equal if metric.better == HIGH else np.less_equal
    words = "at least this overlap" if metric.better == HIGH else "at most this error"

    def shares(rows: Cells) -> FloatArray:
        errors = known(rows[metric.key][rows["status"] == OK])
        count = len(errors) + int((rows["status"] == FAILED).sum())
        return np.asarray(is_within(errors, places[:, None]).sum(axis=1) / max(count, 1))

    return Plot(
        id=f"within_{metric.key}",
        x=metric,
        y=replace(metrics.COVERED, key="share", label=f"objects with {words}", better=HIGH),
        traces=share_traces(runs, places, shares),
        note="over all categories; failures count",
        title=title,
    )


def cumulative_curves(
    runs: Sequence[Run], *, curves: Sequence[tuple[Metric, FloatArray]], of: str
) -> list[Plot]:
    """Curves of the metrics that some run has, each at its places; see `cumulative`."""
    return [
        cumulative(runs, metric, places, title=f"{metric.label} {of}")
        for metric, places in curves
        if any(len(known(run.cells[metric.key])) for run in runs)
    ]
