"""The retrieval experiment: views of a library's models, to be found again in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import QUERIES, Metric
from cadalign.evaluation.options import ModelOptions
from cadalign.evaluation.plots import Plot, Trace
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import OK, Columns, Plan
from cadalign.evaluation.summary import ALL, ConsoleTable, Summary, mean_of, median_of

if TYPE_CHECKING:
    from cadalign.evaluation.instances.queries import RetrievalTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Cells, Run
    from cadalign.retrieval.library import Library

NO_VIEW = "no view"
"""Status of a model of which no view shows as many keypoints as are to be handed over."""
LEAVE_IN = "leave-in"
"""The library holds the true model."""
LEAVE_OUT = "leave-out"
"""It doesn't."""
PROTOCOLS = (LEAVE_IN, LEAVE_OUT)
METHODS = ("optimal", "optimal-unstretched", "epnp")


@dataclass(frozen=True)
class RetrievalRunOptions(ModelOptions):
    """Evaluate the retrieval of CAD models.

    Each model is stretched by factors from 0.5 to 2 along y and z and seen from a random view; some
    of its visible keypoints, with noise, are looked up in a library that holds the model
    (leave-in), and in one that doesn't (leave-out). The run's folder gets results.parquet with a
    row per query, protocol and method, summary.csv, figures and the library. Killed, it goes on
    where it was when the same command is started again.
    """

    experiment = "retrieval"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout, or a library's file."""
    _: KW_ONLY
    noises_px: tuple[float, ...] = (1.0, 3.0, 5.0)
    """Standard deviations of the keypoints' noise, in pixels."""
    keypoints: tuple[int, ...] = (6, 7, 8, 9, 10)
    """Numbers of visible keypoints that are given."""
    protocols: tuple[str, ...] = PROTOCOLS
    """leave-in, leave-out."""
    methods: tuple[str, ...] = ("optimal", "epnp")
    """optimal, optimal-unstretched, epnp."""
    whole_library: bool = False
    """Compare with the models of all categories, not only with those of the right one."""
    shape_sigma: float = 0.02
    """Standard deviation of the keypoints of the best model where the library lacks the right one,
    as a share of their extent."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, known in (("methods", METHODS), ("protocols", PROTOCOLS)):
            chosen = tuple(dict.fromkeys(getattr(self, name)))
            self.replace_values(**{name: chosen})
            unknown = [value for value in chosen if value not in known]
            if unknown or not chosen:
                what = f"unknown: {unknown[0]!r}" if unknown else "none is given"
                raise InputError(what, where=name, fix=f"known are {', '.join(known)}")
        for name, least in (("noises_px", 0), ("keypoints", 4)):
            values = tuple(sorted(set(getattr(self, name))))
            self.replace_values(**{name: values})
            if not values:
                raise InputError("none is given", where=name)
            if not least <= values[0] or not values[-1] < math.inf:
                raise InputError(f"{values[0]:g} is less than {least}", where=name)
        self.check_least(shape_sigma=0)


NAMES: Columns = (
    *(("category", str), ("model_id", str), ("noise_px", float), ("keypoints", int)),
    *(("protocol", str), ("method", str)),
)
COLUMNS: Columns = (
    *(*NAMES, ("status", str), ("reason", str), ("alike", int), ("rank", int)),
    *(("matched_category", str), ("matched_id", str), ("score", float), ("shared", int)),
    ("none_probability", float),
    *(("rms_px", float), ("shape_distance", float), ("box_iou", float)),
    *(("box_iou_up_to_scale", float), ("rotation_error_deg", float)),
)
REQUIRED_COLUMNS: Columns = tuple(
    column for column in COLUMNS if column[0] not in ("box_iou_up_to_scale", "none_probability")
)
"""Those that all runs have; earlier ones lack the others."""
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.RANK_1, metrics.RANK_5, metrics.RECIPROCAL_RANK),
    *(metrics.NONE, metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    *(metrics.MATCH_ROTATION, metrics.QUERY_MILLISECONDS),
)
_KEYPOINTS = replace(metrics.KEYPOINTS, label="keypoints in the image", log=False)
_PLOTS = (
    (metrics.RANK_1, LEAVE_IN),
    (metrics.RANK_5, LEAVE_IN),
    (replace(metrics.BOX_IOU, label="median box IoU"), LEAVE_OUT),
    (replace(metrics.SHAPE_DISTANCE, label="median shape distance"), LEAVE_OUT),
)


def summarize(run: Run) -> list[Summary]:
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


def lines(summaries: Sequence[Summary]) -> list[Summary]:
    """Lines of the headline table, those of a group together."""
    groups: dict[str, list[Summary]] = {}
    for summary in summaries:
        if summary.tasks:
            groups.setdefault(summary.group, []).append(summary)
    return [summary for found in groups.values() for summary in found]


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """Rates and medians over all categories for the console."""
    shown = (
        *(metrics.RANK_1, metrics.RANK_5, metrics.RECIPROCAL_RANK, metrics.SCORE),
        *(metrics.NONE, metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
        *(metrics.MATCH_ROTATION, metrics.QUERY_MILLISECONDS),
    )
    return ConsoleTable(
        title="Rates over the queries, medians of the best match",
        labels=("protocol", "method"),
        heads=("px", metrics.KEYPOINTS.symbol, "n", *(metric.symbol for metric in shown)),
        rows=[
            (
                s["protocol"],
                s.method,
                *(f"{s['noise_px']:g}", str(s["keypoints"]), str(s["queries"])),
                *(metric.text(s[metric.key]) for metric in shown),
            )
            for s in summaries
            if s["category"] == ALL
        ],
        note="",
        narrow=True,
        grouped=False,
    )


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Rates and medians against the number of keypoints, over all categories, for each noise."""
    found = [[s for s in summarize(run) if s["category"] == ALL and s.tasks] for run in runs]
    return [
        _plot(metric, protocol, noise, found)
        for metric, protocol in _PLOTS
        for noise in sorted({s["noise_px"] for summaries in found for s in summaries})
        if any(s["protocol"] == protocol and s["noise_px"] == noise for ss in found for s in ss)
    ]


def _plot(metric: Metric, protocol: str, noise: float, found: Sequence[Sequence[Summary]]) -> Plot:
    chosen = [
        [s for s in summaries if s["protocol"] == protocol and s["noise_px"] == noise]
        for summaries in found
    ]
    traces = []
    for index, summaries in enumerate(chosen):
        for method in dict.fromkeys(s.method for s in summaries):
            rows = [s for s in summaries if s.method == method]
            y = [s[metric.key] for s in rows]
            traces.append(Trace.of(index, method, [s["keypoints"] for s in rows], y, metric))
    queries = sorted({s["queries"] for summaries in chosen for s in summaries})
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
) -> Summary:
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
    up_to_scale = cells.get("box_iou_up_to_scale", np.full(len(solved), np.nan))
    none = cells.get("none_probability", np.full(len(solved), np.nan))
    known = solved & np.isfinite(none)
    ranked = queries and protocol == LEAVE_IN
    values = {
        "queries": queries,
        "failed": queries - int(solved.sum()),
        "rank_1": float((ranks == 1).mean()) if ranked else np.nan,
        "rank_5": float((ranks <= 5).mean()) if ranked else np.nan,
        "reciprocal_rank": float(np.nan_to_num(1 / ranks).mean()) if ranked else np.nan,
        "score": mean_of(cells["score"][solved]),
        "none": float((none > 0.5)[known].mean()) if known.any() else np.nan,
        "shape_distance": median_of(cells["shape_distance"][solved]),
        "box_iou": median_of(cells["box_iou"][solved]),
        "box_iou_up_to_scale": median_of(up_to_scale[solved]),
        "mean_box_iou": mean_of(cells["box_iou"][solved]),
        "rotation_error_deg": median_of(cells["rotation_error_deg"][solved]),
        "milliseconds": median_of(1e3 * cells["seconds"][solved]),
    }
    names = {
        "category": category,
        "protocol": protocol,
        "method": method,
        "noise_px": noise,
        "keypoints": keypoints,
    }
    group = f"{category}, {protocol}, {noise:g} px, {keypoints} keypoints"
    return Summary(group, names, values, tasks=queries)


_CHUNK = 16


def plan(options: RetrievalRunOptions, folder: RunFolder) -> Plan[RetrievalTask]:
    """Plan a run over the models of a library, which the folder gets as ``library.cadalign``."""
    from cadalign.evaluation.instances.queries import retrieval_benchmark, retrieval_tasks

    library = _library_of(options)
    tasks = retrieval_tasks(library, options)
    folder.make()
    file = folder.path / "library.cadalign"
    name = library.fingerprint[:16]
    claimed = folder.read_config()
    # One that no run.json speaks of is from a run that died before it began, perhaps another's; the
    # library of another run, which is to be refused, stays as it is.
    if claimed is None or claimed.get("library") == name:
        library.save(file)
    benchmark = retrieval_benchmark(str(file.absolute()), options)
    return benchmark.plan(options, tasks, chunk=_CHUNK, library=name)


def _library_of(options: RetrievalRunOptions) -> Library:
    """The library at a place, or one of the data set there."""
    from cadalign.retrieval.library import Library

    if options.root.is_file():
        return Library.open(options.root)
    categories = None if options.whole_library else options.categories
    dataset = KeypointNet(options.root, shapenet_root=options.shapenet)
    return Library.from_dataset(dataset, categories=categories)


def _describe(run: Run) -> str:
    models = run.count("category", "model_id")
    return f"of finding {models:,} model{'s' * (models != 1)} of {run.dataset} again"


SPEC = Spec(
    options=RetrievalRunOptions,
    plan=plan,
    columns=HEADLINE,
    results=REQUIRED_COLUMNS,
    summarize=summarize,
    lines=lines,
    table=console_table,
    group=lambda run: QUERIES,
    plots=plots,
    topic="retrieval",
    describe=_describe,
    note=(
        "Leave-in: the library holds the true model; models whose keypoints are the same after "
        "stretch count as it. Leave-out: it and these are taken out. Shape distance, box IoU, "
        "rotation error and time are medians, the first three of the best match. None of "
        "these: the share of queries whose object is more likely none of the models than one."
    ),
)
