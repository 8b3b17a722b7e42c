"""Queries of the retrieval experiment: views of a library's models, to be found again in it.

Every model of the library is stretched by factors from 0.5 to 2 along y and z, seen from a random
view, and some of its visible keypoints are handed over with noise. Models whose keypoints are the
same after a stretch, to within 1 % of their extent and with the same set of keypoints, count as the
true model. Two protocols: ``leave-in``, where the library holds the model, and ``leave-out``, where
it and all that count as it are taken out. All methods get the same keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, IntArray, instance_rng
from cadalign.datasets.models.shapenet import require_category
from cadalign.errors import DegenerateError, InputError
from cadalign.evaluation.benchmark import Benchmark, Case, Setting
from cadalign.evaluation.experiments.retrieval import (
    COLUMNS,
    LEAVE_IN,
    LEAVE_OUT,
    NO_VIEW,
    RetrievalRunOptions,
)
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, STRETCH_RANGE
from cadalign.evaluation.methods import Method
from cadalign.evaluation.metrics.errors import overlap, overlap_up_to_scale
from cadalign.evaluation.runs.work import Row
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.metrics import rotation_error
from cadalign.retrieval.absence import SAME_SHAPE, distances, shape_distance
from cadalign.retrieval.library import Library
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import LibraryModel, ModelKey

TOP = 50
"""Ranks beyond this are one."""
_LEAST_SIGMA = 0.5  # keypoints without noise would leave no other model any chance
_OPTIONS: dict[str, dict[str, Any]] = {
    "optimal": {},
    "optimal-unstretched": {"stretch": "none"},
    "epnp": {"method": "epnp"},
}
"""Options of `cadalign.Library.retrieve` by method."""
_NO_MATCH: Row = {"matched_category": "", "matched_id": ""}


@dataclass(frozen=True)
class RetrievalTask:
    """One view of one model, with a level of noise and a number of keypoints."""

    category: str
    model_id: str
    noise_px: float
    keypoints: int

    def names(self, protocol: str) -> Row:
        """The cells that name the rows of a protocol, but for the method."""
        return {**asdict(self), "protocol": protocol}


def retrieval_tasks(library: Library, options: RetrievalRunOptions) -> list[RetrievalTask]:
    """Every model with every noise and number of keypoints that it has, model by model."""
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
                RetrievalTask(*key, noise, keypoints)
                for noise in options.noises_px
                for keypoints in options.keypoints
                if keypoints <= most
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
    keypoints alone; see `cadalign.evaluation.instances.hull`.
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


@dataclass(frozen=True, eq=False)
class RetrievalInstance:
    """A query of a library's file, with the models that count as the true one."""

    task: RetrievalTask
    query: RetrievalQuery
    gt: LibraryModel
    alike: frozenset[ModelKey]
    protocol: str


@dataclass(frozen=True)
class RetrievalQueries(Setting):
    """Queries of a library's file, which all workers map into memory: the experiment's setting."""

    columns = COLUMNS

    library: str
    options: RetrievalRunOptions

    def failed(self, task: RetrievalTask) -> list[Case]:
        return [Case(task.names(protocol), _NO_MATCH) for protocol in self.options.protocols]

    def _cases(self, task: RetrievalTask) -> list[Case]:
        library, cases = _opened(self.library), self.failed(task)
        gt = library[task.category, task.model_id]
        try:
            query = observe_model(gt, task, seed=self.options.seed)
        except DegenerateError as error:
            return [replace(case, error=error, status=NO_VIEW) for case in cases]
        seen = task, query, gt, same_shapes(library, gt.key)
        return [
            replace(case, instance=RetrievalInstance(*seen, protocol))
            for case, protocol in zip(cases, self.options.protocols, strict=True)
        ]

    def row(self, method: Method, instance: RetrievalInstance, matches: Sequence[Match]) -> Row:
        """Compare matches with the true model; errors are those of the first match."""
        first, gt, placed = matches[0], instance.gt, instance.query.gt
        best = _opened(self.library)[first.category, first.model_id]
        boxes = {"est": first.box, "gt": Box.from_model(gt.bounds, placed)}
        keys = [(match.category, match.model_id) for match in matches]
        ranks = (rank for rank, key in enumerate(keys, start=1) if key in instance.alike)
        return {
            "alike": len(instance.alike),
            "rank": next(ranks, None),
            "matched_category": first.category,
            "matched_id": first.model_id,
            "score": first.score,
            "none_probability": first.none_probability,
            "shared": first.shared,
            "rms_px": first.rms,
            "shape_distance": shape_distance(best, gt) if best.category == gt.category else None,
            "box_iou": overlap(**boxes),
            "box_iou_up_to_scale": overlap_up_to_scale(**boxes),
            "rotation_error_deg": rotation_error(est=first.alignment, gt=placed),
        }


def retrieval_benchmark(library: str, options: RetrievalRunOptions) -> Benchmark:
    """The methods of the options on queries of a library's file."""
    how: dict[str, Any] = {"library": library, "options": options}
    methods = (Method(name, partial(_retrieve, method=name, **how)) for name in options.methods)
    return Benchmark(RetrievalQueries(library, options), tuple(methods))


def _retrieve(
    instance: RetrievalInstance, *, method: str, library: str, options: RetrievalRunOptions
) -> list[Match]:
    task = instance.task
    is_exact = instance.protocol == LEAVE_IN and method == "optimal"
    return _opened(library).retrieve(
        instance.query.points_2d,
        instance.query.ids,
        KEYPOINT_CAMERA,
        top=TOP,
        category=None if options.whole_library else task.category,
        sigma=max(task.noise_px, _LEAST_SIGMA),
        shape_sigma=0.0 if is_exact else options.shape_sigma,
        exclude=instance.alike if instance.protocol == LEAVE_OUT else (),
        workers=1,
        **_OPTIONS[method],
    )


_opened = lru_cache(maxsize=2)(Library.open)


@lru_cache(maxsize=64)
def same_shapes(library: Library, key: ModelKey) -> frozenset[ModelKey]:
    """The models of a library that count as the given one, itself among them."""
    gt = library[key]
    keys, xyz = _by_keypoints(library)[gt.category, tuple(gt.ids.tolist())]
    near = distances(xyz, gt.xyz) <= SAME_SHAPE
    return frozenset([key, *(keys[k] for k in np.flatnonzero(near).tolist())])


@lru_cache(maxsize=2)
def _by_keypoints(library: Library) -> dict[Any, tuple[list[ModelKey], FloatArray]]:
    groups: dict[Any, list[LibraryModel]] = {}
    for model in library:
        groups.setdefault((model.category, tuple(model.ids.tolist())), []).append(model)
    return {
        ids: ([model.key for model in models], np.array([model.xyz for model in models]))
        for ids, models in groups.items()
    }
