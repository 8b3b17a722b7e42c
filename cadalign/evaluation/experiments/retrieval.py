"""The experiment on retrieval: views of a library's models, to be found again in it.

Models whose keypoints are the same after a stretch, to within 1 % of their extent and with the same
set of keypoints, count as the true model. Two protocols: ``leave-in``, where the library holds the
model, and ``leave-out``, where it and all that count as it are taken out.
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
    known,
    mean_of,
    median,
    medians,
    milliseconds,
    summarize,
)
from cadalign.geometry.alignment import Alignment, Box
from cadalign.io.files import made_folder
from cadalign.metrics import rotation_error

if TYPE_CHECKING:
    # Only where a run needs them: they load the compiled solvers.
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.retrieval.models import LibraryModel, ModelKey

LEAVE_IN, LEAVE_OUT = "leave-in", "leave-out"
"""Protocols: the library holds the true model, or it doesn't."""

METHOD = "optimal"
"""The name of the one method, `cadalign.Library.retrieve`."""


@dataclass(frozen=True)
class RetrievalRunOptions(ModelOptions):
    """Evaluate the retrieval of CAD models.

    Stretches each model by factors from 0.5 to 2 along y and z, and draws a random view. Some of
    its visible keypoints, with noise, are the query of a library with the model (leave-in) and of
    a library without it (leave-out). Writes results.parquet with a row per query and protocol,
    summary.csv, figures and the library. A killed run continues when the same command is started
    again.
    """

    experiment = "retrieval"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of a data set in KeypointNet's layout, or a library file."""
    _: KW_ONLY
    noise_px: float = 1.0
    """Standard deviation of the keypoint noise [px]."""
    keypoints: tuple[int, ...] = (6, 7, 8, 9, 10)
    """Numbers of visible keypoints per query."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_noise("noise_px")
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
"""Ranks beyond this are one."""
_SHAPE_SIGMA = 0.02  # of the keypoints of the best model where the right one lacks, of their extent
_LEAST_SIGMA = 0.5  # keypoints without noise would leave no other model any chance


@dataclass(frozen=True)
class RetrievalTask:
    """One view of one model, with a level of noise, a number of keypoints, and a protocol."""

    category: str
    model_id: str
    noise_px: float
    keypoints: int
    protocol: str = LEAVE_IN

    @property
    def names(self) -> Row:
        """The cells that name its rows, but for the method."""
        return asdict(self)


def retrieval_tasks(library: Library, options: RetrievalRunOptions) -> list[RetrievalTask]:
    """Every model with every number of keypoints that it has, model by model."""
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
    """View of a stretched model: noisy keypoints [px], and its true pose and stretch."""

    points_2d: FloatArray
    ids: IntArray
    gt: Alignment


def observe_model(model: LibraryModel, task: RetrievalTask, *, seed: int) -> RetrievalQuery:
    """Stretch a model, draw a view of it, and hand over some of its visible keypoints.

    Everything random follows from the seed and the task. Visibility follows from the
    keypoints alone; see `cadalign.evaluation.instances.instance`.
    """
    rng = instance_rng(seed, task.category, task.model_id, repr(task.noise_px), str(task.keypoints))
    stretch = np.array([1.0, *rng.uniform(*STRETCH_RANGE, 2)])
    hull = KeypointHull(model.xyz * stretch)
    pose, visible = sample_hull_view(hull, KEYPOINT_CAMERA, rng=rng, min_visible=task.keypoints)
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
    """Queries of a library's file, which all workers map into memory: the experiment's setting."""

    columns = COLUMNS

    library: str
    options: RetrievalRunOptions

    def case(self, task: RetrievalTask) -> Case:
        library = opened_library(self.library)
        model = library[task.category, task.model_id]
        same_shapes(library, model.key)  # kept at hand: no query's time holds it
        query = observe_model(model, task, seed=self.options.seed)
        return Case(task.names, instance=(task, query))

    def row(self, method: Method, instance: RetrievalInstance, matches: Sequence[Match]) -> Row:
        """Compare matches with the true model; errors are those of the first match."""
        from cadalign.retrieval.absence import shape_distance

        (task, query), library, first = instance, opened_library(self.library), matches[0]
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
    """Retrieval from a library's file."""
    method = Method(METHOD, partial(_retrieve, library=library))
    return Benchmark(RetrievalQueries(library, options), (method,))


def _retrieve(instance: RetrievalInstance, *, library: str) -> list[Match]:
    (task, query), opened = instance, opened_library(library)
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
def opened_library(path: str | Path) -> Library:
    """The library of a file, read once in every process."""
    from cadalign.retrieval.library import Library

    return Library.open(path)


@lru_cache(maxsize=64)
def same_shapes(library: Library, key: ModelKey) -> frozenset[ModelKey]:
    """The models of a library that count as the given one, itself among them."""
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


def _of_ranks(statistic: Callable[[FloatArray], FloatArray]) -> Callable[[Group], float]:
    """Mean of a number of the ranks, NaN beyond 50, where the library holds the true model."""

    def made(group: Group) -> float:
        ranked = group.rows["protocol"] == LEAVE_IN
        return mean_of(statistic(group.rows["rank"][ranked].astype(float)))

    return made


_STATISTICS = {
    "rank_1": _of_ranks(lambda ranks: (ranks == 1).astype(float)),
    "reciprocal_rank": _of_ranks(lambda ranks: np.nan_to_num(1 / ranks)),
    "none": lambda group: mean_of(known(group.solved["none_probability"]) > 0.5),
    **medians(metrics.SHAPE_DISTANCE, metrics.BOX_IOU, metrics.BOX_IOU_UP_TO_SCALE),
    "rotation_error_deg": median("rotation_error_deg"),
    "milliseconds": milliseconds,
}


def summarize_queries(run: Run) -> list[Summary]:
    """A summary for every category, protocol and number of keypoints."""
    return summarize(
        run,
        _STATISTICS,
        by=("category", "protocol", "keypoints"),
        name="{}, {}, {} keypoints".format,
    )


_CHUNK = 16


def plan(options: RetrievalRunOptions, folder: RunFolder) -> Plan[RetrievalTask]:
    """Plan a run over the models of a library, which the folder gets, named after its hash."""
    from cadalign.retrieval.library import Library

    if options.root.is_file():
        library = Library.open(options.root)
    else:
        dataset = KeypointNet(options.root, shapenet_root=options.shapenet)
        library = Library.from_models(dataset.subset(categories=options.categories))
    tasks = retrieval_tasks(library, options)
    name = library.fingerprint[:16]
    file = made_folder(folder.path / "library") / f"{name}.cadalign"
    if not file.is_file():
        library.save(file)
    benchmark = retrieval_benchmark(str(file.absolute()), options)
    return benchmark.plan(options, tasks, chunk=_CHUNK, library=name)


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
        "Leave-in: the library holds the true model; models whose keypoints are the same after "
        "stretch count as it. Leave-out: it and these are taken out. Shape distance, box IoU, "
        "rotation error and time are medians, the first three of the best match. None of "
        "these: the share of queries whose object is more likely none of the models than one."
    ),
)
