"""What is made of a retrieval run's results: a table of rates, and figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from cadalign.evaluation.accuracy.outcome import OK
from cadalign.evaluation.accuracy.style import look_of, new_figure, save_figure
from cadalign.evaluation.retrieval.outcome import LEAVE_IN, LEAVE_OUT, NO_VIEW
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import read_table
from cadalign.io.files import write_text, writing

ALL = "all"
"""What the summary over all categories is called."""
_Cells = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class RetrievalSummary:
    """What one method did on one category's queries of one kind.

    Parameters
    ----------
    category, protocol, method : str
    noise_px : float
        [px]
    keypoints : int
        How many were handed over.
    queries : int
        How many were made; models without a view that shows enough keypoints are not counted.
    failed : int
        How many of these gave no match.
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


def write_retrieval_report(folder: RunFolder) -> list[RetrievalSummary]:
    """Write ``summary.csv`` and ``figures`` of a finished run.

    Raises
    ------
    DataError
        If the results cannot be read or the files cannot be written.
    """
    summaries = summarize_retrieval(folder)
    text = io.StringIO()
    writer = csv.DictWriter(
        text, [field.name for field in fields(RetrievalSummary)], lineterminator="\n"
    )
    writer.writeheader()
    for summary in summaries:
        row = asdict(summary)
        writer.writerow({name: "" if value != value else value for name, value in row.items()})
    write_text(folder.summary, text.getvalue())
    with writing(folder.figures):
        folder.figures.mkdir(exist_ok=True)
    total = [summary for summary in summaries if summary.category == ALL]
    for protocol, name, label, value in _FIGURES:
        shown = [summary for summary in total if summary.protocol == protocol and summary.queries]
        if shown:
            title = f"{protocol}; {label}"
            draw_curves(folder.figures / name, shown, label=label, title=title, value=value)
    return summaries


def summarize_retrieval(folder: RunFolder) -> list[RetrievalSummary]:
    """A summary for every category, protocol, method, noise and number of keypoints."""
    return summarize_retrieval_tables(
        read_table(folder.results), read_table(folder.timings, columns=["seconds"])
    )


def summarize_retrieval_tables(results: pa.Table, timings: pa.Table) -> list[RetrievalSummary]:
    """The same of its tables, which may be those of an unfinished run."""
    cells = {name: results[name].to_numpy(zero_copy_only=False) for name in results.column_names}
    seconds = np.full(len(results), np.nan)
    if len(timings) == len(results):  # they may not have been kept
        seconds = timings["seconds"].to_numpy(zero_copy_only=False).astype(float)
    cells["milliseconds"] = 1e3 * seconds
    categories = sorted(set(cells["category"].tolist()))
    groups = [*categories, ALL] if len(categories) > 1 else [ALL]
    return [
        _summarize(cells, category, protocol, method, noise, keypoints)
        for category in groups
        for protocol in dict.fromkeys(cells["protocol"].tolist())
        for method in dict.fromkeys(cells["method"].tolist())
        for noise in np.unique(cells["noise_px"]).tolist()
        for keypoints in np.unique(cells["keypoints"]).tolist()
    ]


def draw_curves(
    path: Path,
    summaries: Sequence[RetrievalSummary],
    *,
    label: str,
    title: str,
    value: Callable[[RetrievalSummary], float],
) -> list[Path]:
    """Draw a value against the number of keypoints, a line for each method and noise.

    Parameters
    ----------
    path : Path
        Without an ending.
    summaries : sequence of RetrievalSummary
        Of one category and protocol.
    label, title : str
    value : callable
        What to draw of a summary.
    """
    noises = sorted({summary.noise_px for summary in summaries})
    dashes = ("-", "--", ":", "-.")
    with new_figure(figsize=(6.4, 4.2)) as figure:
        axes = figure.add_subplot()
        for method in dict.fromkeys(summary.method for summary in summaries):
            look = look_of(_LOOKS.get(method, method))
            for place, noise in enumerate(noises):
                rows = [s for s in summaries if s.method == method and s.noise_px == noise]
                axes.plot(
                    [row.keypoints for row in rows],
                    [value(row) for row in rows],
                    color=look.color,
                    marker=look.marker,
                    linestyle=dashes[place % len(dashes)],
                    label=f"{_LABELS.get(method, method)}, {noise:g} px",
                )
        axes.set_xticks(sorted({summary.keypoints for summary in summaries}))
        axes.set_xlabel("keypoints in the image")
        axes.set_ylabel(label)
        queries = sorted({summary.queries for summary in summaries})
        count = f"{queries[0]:,} to {queries[-1]:,}" if len(queries) > 1 else f"{queries[0]:,}"
        axes.set_title(f"{title}; {count} queries each", fontsize=9, color="0.35", loc="left")
        figure.legend(loc="outside lower center", ncols=2, handlelength=3.6)
        return save_figure(figure, path)


_LOOKS = {"optimal-unstretched": "aepnp"}
_LABELS = {
    "optimal": "optimal, with stretch",
    "optimal-unstretched": "optimal, without stretch",
    "epnp": "EPnP, without stretch",
}
_FIGURES: tuple[tuple[str, str, str, Callable[[RetrievalSummary], float]], ...] = (
    (LEAVE_IN, "leave_in_rank_1", "true model first [%]", lambda s: 100 * s.rank_1),
    (LEAVE_IN, "leave_in_rank_5", "true model among the first 5 [%]", lambda s: 100 * s.rank_5),
    (LEAVE_OUT, "leave_out_box_iou", "median box IoU", lambda s: s.box_iou),
    (
        LEAVE_OUT,
        "leave_out_shape_distance",
        "median shape distance [% of extent]",
        lambda s: 100 * s.shape_distance,
    ),
)


def _summarize(
    cells: _Cells, category: str, protocol: str, method: str, noise: float, keypoints: int
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
        score=_over(np.mean, cells["score"][solved]),
        shape_distance=_over(np.median, cells["shape_distance"][solved]),
        box_iou=_over(np.median, cells["box_iou"][solved]),
        mean_box_iou=_over(np.mean, cells["box_iou"][solved]),
        rotation_error_deg=_over(np.median, cells["rotation_error_deg"][solved]),
        milliseconds=_over(np.median, cells["milliseconds"][solved]),
    )


def _over(average: Callable[..., Any], values: npt.NDArray[Any]) -> float:
    """An average of what is known; NaN if nothing is."""
    known = values.astype(float)
    known = known[~np.isnan(known)]
    return float(average(known)) if len(known) else np.nan
