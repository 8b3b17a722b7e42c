"""Experiment on retrieval: find a library's models from views of them.

A model counts as equal to the true one if it has the same set of keypoints, and they agree after a
stretch to within 1 % of their extent. Two protocols: ``leave-in``, where the library holds the true
model, and ``leave-out``, where the true model and its equals are removed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from cadalign.arrays import FloatArray, IntArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.datasets.shapenet import require_category
from cadalign.errors import InputError
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import Benchmark, Case, Setting
from cadalign.evaluation.instances.instance import (
    KEYPOINT_CAMERA,
    STRETCH_RANGE,
    KeypointHull,
    sample_hull_view,
)
from cadalign.evaluation.methods import Method
from cadalign.evaluation.metrics import QUERIES
from cadalign.evaluation.metrics.errors import overlap
from cadalign.evaluation.options import ModelOptions
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Columns, Plan, Row
from cadalign.evaluation.summary import (
    Group,
    Summary,
    drop_nan,
    mean_of,
    median,
    medians,
    milliseconds,
    summarize,
)
from cadalign.geometry.alignment import Alignment, Box
from cadalign.io.files import create_folder
from cadalign.metrics import rotation_error

if TYPE_CHECKING:
    # Imported late elsewhere: they load the compiled solvers.
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.retrieval.models import LibraryModel, ModelKey

LEAVE_IN, LEAVE_OUT = "leave-in", "leave-out"
"""Protocols: the library holds the true model, or does not."""

METHOD = "optimal"
"""Name of the only method, `cadalign.Library.retrieve`."""


@dataclass(frozen=True)
class RetrievalRunOptions(ModelOptions):
    """Evaluate the retrieval of CAD models.

    Each model is stretched by random factors from 0.5 to 2 along y and z and seen from a random
    view. The query is some of its visible keypoints with noise. It goes to a library that holds the
    model (leave-in), and to one that does not (leave-out). The run's folder gets results.parquet
    with a row per query and protocol, summary.csv, figures and the library. An interrupted run
    continues when the same command is started again.
    """

    experiment = "retrieval"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout, or the file of a library."""
    _: KW_ONLY
    keypoints: tuple[int, ...] = (6, 7, 8, 9, 10)
    """Numbers of keypoints per query; each number is evaluated."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.replace_values(keypoints=tuple(sorted(set(self.keypoints))))
        if not self.keypoints:
            raise InputError("none is given", where="keypoints")
        if self.keypoints[0] < 4:
            raise InputError(f"{self.keypoints[0]} is less than 4", where="keypoints")


COLUMNS: Columns = (
    *(("category", str), ("model_id", str), ("noise_px", float), ("keypoints", int)),
    *(("protocol", str), ("method", str), ("status", str), ("reason", str)),
    *(("rank", int), ("matched_id", str), ("score", float), ("shared", int)),
    *(("none_probability", float), ("rms_px", float), ("shape_distance", float)),
    *(("box_iou", float), ("box_iou_up_to_scale", float), ("rotation_error_deg", float)),
)

TOP = 50
"""Number of matches per query; ranks beyond it are missing."""
_SHAPE_SIGMA = 0.02  # of a similar model's keypoints, relative to their extent
_LEAST_SIGMA = 0.5  # [px]; without noise, similar models would have no likelihood


@dataclass(frozen=True)
class RetrievalTask:
    """One view of one model: noise, number of keypoints, and protocol."""

    category: str
    model_id: str
    noise_px: float
    keypoints: int
    protocol: str = LEAVE_IN

    @property
    def names(self) -> Row:
        """The cells that identify its rows, without the method."""
        return asdict(self)


def retrieval_tasks(library: Library, options: RetrievalRunOptions) -> list[RetrievalTask]:
    """Tasks of every model, with every number of keypoints that the model has."""
    names = library.categories
    if options.categories is not None:
        chosen = {require_category(name, names, where="categories") for name in options.categories}
        names = tuple(sorted(chosen))
    tasks = []
    for name in names:
        own = [key for key in library.keys if key[0] == name]
        count = min(len(own), options.max_models or len(own))
        for key in (own[i * len(own) // count] for i in range(count)):
            most = len(library[key].xyz)
            tasks += [
                RetrievalTask(*key, options.noise_px, keypoints, protocol)
                for keypoints in options.keypoints
                if keypoints <= most
                for protocol in (LEAVE_IN, LEAVE_OUT)
            ]
    if not tasks:
        raise InputError(f"no model has {options.keypoints[0]} keypoints", where="keypoints")
    return tasks


@dataclass(frozen=True, eq=False)
class RetrievalQuery:
    """A view of a stretched model: noisy keypoints [px], true pose and stretch."""

    points_2d: FloatArray
    ids: IntArray
    gt: Alignment


def observe_model(model: LibraryModel, task: RetrievalTask, *, seed: int) -> RetrievalQuery:
    """Stretch a model, draw a view, and select some of the visible keypoints.

    The query depends only on the seed and the task. Visibility is found from the keypoints' convex
    hull; see `cadalign.evaluation.instances.instance`.
    """
    rng = instance_rng(seed, task.category, task.model_id, repr(task.noise_px), str(task.keypoints))
    stretch = np.array([1.0, *rng.uniform(*STRETCH_RANGE, 2)])
    hull = KeypointHull(model.xyz * stretch)
    pose, visible = sample_hull_view(hull, rng=rng, min_visible=task.keypoints)
    chosen = np.sort(rng.choice(np.flatnonzero(visible), task.keypoints, replace=False))
    pixels = KEYPOINT_CAMERA.project(pose.apply(hull.xyz[chosen]))
    return RetrievalQuery(
        points_2d=pixels + task.noise_px * rng.standard_normal(pixels.shape),
        ids=model.ids[chosen],
        gt=Alignment(pose.rotation, pose.translation, stretch),
    )


RetrievalInstance = tuple[RetrievalTask, RetrievalQuery]


@dataclass(frozen=True)
class RetrievalQueries(Setting):
    """Instances of the experiment: queries to a library's file, which workers map into memory."""

    columns = COLUMNS

    library: str
    options: RetrievalRunOptions

    def case(self, task: RetrievalTask) -> Case:
        library = open_library(self.library)
        model = library[task.category, task.model_id]
        same_shapes(library, model.key)  # cached, so that no query is timed with it
        query = observe_model(model, task, seed=self.options.seed)
        return Case(task.names, instance=(task, query))

    def row(self, method: Method, instance: RetrievalInstance, matches: Sequence[Match]) -> Row:
        """Rank of the true model, and errors of the first match."""
        from cadalign.retrieval.absence import shape_distance

        (task, query), library, first = instance, open_library(self.library), matches[0]
        gt = library[task.category, task.model_id]
        alike = same_shapes(library, gt.key)
        gt_box = Box.from_model(gt.bounds, query.gt)
        keys = [(match.category, match.model_id) for match in matches]
        ranks = (rank for rank, key in enumerate(keys, start=1) if key in alike)
        best = library[first.category, first.model_id]
        return {
            "rank": next(ranks, None),
            "matched_id": first.model_id,
            "score": first.score,
            "none_probability": first.none_probability,
            "shared": first.shared,
            "rms_px": first.rms,
            "shape_distance": shape_distance(best, gt),
            "box_iou": overlap(est=first.box, gt=gt_box),
            "box_iou_up_to_scale": overlap(est=first.box, gt=gt_box, up_to_scale=True),
            "rotation_error_deg": rotation_error(est=first.alignment, gt=query.gt),
        }


def retrieval_benchmark(library: str, options: RetrievalRunOptions) -> Benchmark:
    """The benchmark of retrieval from a library's file."""
    method = Method(METHOD, partial(_retrieve, library=library))
    return Benchmark(RetrievalQueries(library, options), (method,))


def _retrieve(instance: RetrievalInstance, *, library: str) -> list[Match]:
    (task, query), opened = instance, open_library(library)
    leaves_out = task.protocol == LEAVE_OUT
    return opened.retrieve(
        query.points_2d,
        query.ids,
        KEYPOINT_CAMERA,
        top=TOP,
        category=task.category,
        sigma=max(task.noise_px, _LEAST_SIGMA),
        shape_sigma=_SHAPE_SIGMA if leaves_out else 0.0,
        exclude=same_shapes(opened, (task.category, task.model_id)) if leaves_out else (),
        workers=1,
    )


@lru_cache(maxsize=2)
def open_library(path: str | Path) -> Library:
    """Open a library, once per process."""
    from cadalign.retrieval.library import Library

    return Library.open(path)


@lru_cache(maxsize=64)
def same_shapes(library: Library, key: ModelKey) -> frozenset[ModelKey]:
    """Keys of the library's models that count as equal to a model, itself included."""
    from cadalign.retrieval.absence import SAME_SHAPE, distances

    gt = library[key]
    models = [library[each] for each in library.keys if each[0] == gt.category]
    models = [model for model in models if np.array_equal(model.ids, gt.ids)]
    near = distances(np.array([model.xyz for model in models]), gt.xyz) <= SAME_SHAPE
    return frozenset([key, *(models[k].key for k in np.flatnonzero(near).tolist())])


# Summary ------------------------------------------------------------------------------------------

HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.RANK_1, metrics.RECIPROCAL_RANK),
    *(metrics.NONE, metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    *(metrics.ROTATION, metrics.QUERY_MILLISECONDS),
)


def _rank_statistic(statistic: Callable[[FloatArray], FloatArray]) -> Callable[[Group], float]:
    """Mean of a function of the leave-in ranks, which are NaN beyond `TOP`."""

    def made(group: Group) -> float:
        ranked = group.rows["protocol"] == LEAVE_IN
        return mean_of(statistic(group.rows["rank"][ranked].astype(float)))

    return made


_STATISTICS = {
    "rank_1": _rank_statistic(lambda ranks: (ranks == 1).astype(float)),
    "reciprocal_rank": _rank_statistic(lambda ranks: np.nan_to_num(1 / ranks)),
    "none": lambda group: mean_of(drop_nan(group.solved["none_probability"]) > 0.5),
    **medians(metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    "rotation_error_deg": median("rotation_error_deg"),
    "milliseconds": milliseconds,
}


def summarize_queries(run: Run) -> list[Summary]:
    """One summary per category, protocol and number of keypoints."""
    return summarize(
        run,
        _STATISTICS,
        by=("category", "protocol", "keypoints"),
        name="{}, {}, {} keypoints".format,
    )


def plan(options: RetrievalRunOptions, folder: RunFolder) -> Plan[RetrievalTask]:
    """Plan a run over a library's models; the run's folder gets the library."""
    from cadalign.retrieval.library import Library

    if options.root.is_file():
        library = Library.open(options.root)
    else:
        dataset = KeypointNet(options.root, shapenet_root=options.shapenet)
        library = Library.from_models(dataset.subset(categories=options.categories))
    tasks = retrieval_tasks(library, options)
    name = library.fingerprint[:16]
    file = create_folder(folder.path / "library") / f"{name}.cadalign"
    if not file.is_file():
        library.save(file)
    benchmark = retrieval_benchmark(str(file.absolute()), options)
    return benchmark.plan(options, tasks, chunk=16, library=name)


SPEC = Spec(
    options=RetrievalRunOptions,
    plan=plan,
    columns=HEADLINE,
    results=COLUMNS,
    summarize=summarize_queries,
    console=HEADLINE[2:],
    group=lambda run: QUERIES,
    topic="retrieval",
    subject="views of models",
    note=(
        "Leave-in: the library holds the true model; models with the same keypoints after a "
        "stretch count as equal to it. Leave-out: the true model and its equals are removed. Shape "
        "distance, box IoU and rotation error are medians of the best match; time is a median. "
        "None of these: the share of queries with more than 50 % probability that the object is "
        "none of the models."
    ),
)
