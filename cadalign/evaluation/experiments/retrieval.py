"""The retrieval experiment: views of a library's models, to be found again in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.metrics import QUERIES
from cadalign.evaluation.options import ModelOptions
from cadalign.evaluation.plots import Plot, plot_against
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Plan
from cadalign.evaluation.summary import (
    ALL,
    Group,
    Summary,
    known,
    mean,
    mean_of,
    median,
    medians,
    milliseconds,
    summarize,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.queries import RetrievalTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run
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
        for name, choices in (("methods", METHODS), ("protocols", PROTOCOLS)):
            chosen = tuple(dict.fromkeys(getattr(self, name)))
            self.replace_values(**{name: chosen})
            unknown = [value for value in chosen if value not in choices]
            if unknown or not chosen:
                what = f"unknown: {unknown[0]!r}" if unknown else "none is given"
                raise InputError(what, where=name, fix=f"known are {', '.join(choices)}")
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


def _of_ranks(statistic: Callable[[FloatArray], FloatArray]) -> Callable[[Group], float]:
    """Mean of a number of the ranks, NaN beyond 50, where the library holds the true model."""

    def made(group: Group) -> float:
        ranked = group.rows["protocol"] == LEAVE_IN
        return mean_of(statistic(group.rows["rank"][ranked].astype(float)))

    return made


_STATISTICS = {
    "rank_1": _of_ranks(lambda ranks: (ranks == 1).astype(float)),
    "rank_5": _of_ranks(lambda ranks: (ranks <= 5).astype(float)),
    "reciprocal_rank": _of_ranks(lambda ranks: np.nan_to_num(1 / ranks)),
    "score": mean("score"),
    "none": lambda group: mean_of(known(group.solved["none_probability"]) > 0.5),
    **medians(metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    "mean_box_iou": mean("box_iou"),
    "rotation_error_deg": median("rotation_error_deg"),
    "milliseconds": milliseconds,
}


def summarize_queries(run: Run) -> list[Summary]:
    """A summary for every category, protocol, noise, number of keypoints and method."""
    return summarize(
        run,
        _STATISTICS,
        by=("category", "protocol", "noise_px", "keypoints"),
        name="{}, {}, {:g} px, {} keypoints".format,
        apart=NO_VIEW,
    )


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Rates and medians against the number of keypoints, over all categories, for each noise."""
    found = []
    for run in runs:
        summaries = summarize_queries(run)
        whole = {each["category"] for each in summaries}
        kept = ALL if len(whole) > 1 else next(iter(whole))
        found.append([each for each in summaries if each["category"] == kept])
    drawn = []
    for metric, protocol in _PLOTS:
        for noise in sorted({each["noise_px"] for summaries in found for each in summaries}):
            chosen = [
                [s for s in some if (s["protocol"], s["noise_px"]) == (protocol, noise)]
                for some in found
            ]
            if any(chosen):
                words = {
                    "id": f"{protocol.replace('-', '_')}_{metric.key}_{noise:g}",
                    "note": "over all categories",
                    "title": f"{metric.label}, {noise:g} px of noise, {protocol}",
                }
                drawn.append(plot_against(chosen, _KEYPOINTS, metric, place="keypoints", **words))
    return drawn


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


SPEC = Spec(
    options=RetrievalRunOptions,
    plan=plan,
    columns=HEADLINE,
    results=COLUMNS,
    summarize=summarize_queries,
    console=HEADLINE[2:],
    apart=NO_VIEW,
    group=lambda run: QUERIES,
    plots=plots,
    topic="retrieval",
    subject="views of models",
    note=(
        "Leave-in: the library holds the true model; models whose keypoints are the same after "
        "stretch count as it. Leave-out: it and these are taken out. Shape distance, box IoU, "
        "rotation error and time are medians, the first three of the best match. None of "
        "these: the share of queries whose object is more likely none of the models than one."
    ),
)
