"""The retrieval experiment: views of a library's models, to be found again in it.

Every model of the library is stretched by factors from 0.5 to 2 along y and z, seen from a random
view, and some of its visible keypoints are handed over with noise. Models whose keypoints are the
same after stretch, to within 1 % of their extent and with the same set of keypoints, count as the
true model. Two protocols: ``leave-in``, where the library holds the model, and ``leave-out``, where
it and all that count as it are taken out. All methods get the same keypoints.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.alignment import Alignment
from cadalign.camera import Camera
from cadalign.errors import CadalignError, DegenerateError, InputError
from cadalign.evaluation.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instance import KEYPOINT_CAMERA, STRETCH_RANGE
from cadalign.evaluation.outcome import FAILED
from cadalign.evaluation.retrieval_outcome import (
    LEAVE_IN,
    LEAVE_OUT,
    NO_VIEW,
    PROTOCOLS,
    RetrievalOutcome,
)
from cadalign.evaluation.run import Progress, RunFolder, execute, workers_of
from cadalign.evaluation.work import Columns, Result, reason_of
from cadalign.retrieval.library import Library
from cadalign.retrieval.models import LibraryModel, ModelKey
from cadalign.retrieval.shape import SAME_SHAPE, distances
from cadalign.seeding import instance_rng
from cadalign.validation import FloatArray, IntArray

METHODS: dict[str, dict[str, Any]] = {
    "optimal": {},
    "optimal-unstretched": {"stretch": "none"},
    "epnp": {"method": "epnp"},
}
"""What can be evaluated, with the options of `cadalign.Library.retrieve`."""
TOP = 50
"""Ranks beyond this are not told apart."""
_LEAST_SIGMA = 0.5  # keypoints without noise would leave no other model any chance
# Part of a run's configuration: another size would cut a half-done run into other chunks.
_CHUNK = 16


@dataclass(frozen=True)
class RetrievalEvaluation:
    """How to evaluate retrieval.

    Parameters
    ----------
    categories : tuple of str, optional
        Of the models to find; by default all.
    noises_px : tuple of float
        Standard deviations of the keypoints' noise [px]; kept sorted.
    keypoints : tuple of int
        How many keypoints are handed over; kept sorted.
    protocols : tuple of str
        ``leave-in``, ``leave-out``.
    methods : tuple of str
        Names in `METHODS`.
    whole_library : bool
        Whether the category is to be found, too: the models of all categories are compared.
    shape_sigma : float
        Handed to `cadalign.Library.retrieve` where the right shape is not to be had: in the
        leave-out protocol, and by methods that don't stretch.
    max_models : int, optional
        How many models of each category at most, evenly spread over their ids.
    seed : int

    Raises
    ------
    InputError
        If a value is out of range or unknown.
    """

    categories: tuple[str, ...] | None = None
    noises_px: tuple[float, ...] = (1.0, 3.0, 5.0)
    keypoints: tuple[int, ...] = (6, 7, 8, 9, 10)
    protocols: tuple[str, ...] = PROTOCOLS
    methods: tuple[str, ...] = ("optimal", "epnp")
    whole_library: bool = False
    shape_sigma: float = 0.02
    max_models: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name, known in (("methods", tuple(METHODS)), ("protocols", PROTOCOLS)):
            chosen = tuple(dict.fromkeys(getattr(self, name)))
            object.__setattr__(self, name, chosen)
            unknown = [value for value in chosen if value not in known]
            if unknown or not chosen:
                what = f"unknown: {unknown[0]!r}" if unknown else "none is given"
                raise InputError(what, where=name, fix=f"known are {', '.join(known)}")
        for name, least in (("noises_px", 0), ("keypoints", 4)):
            values = tuple(sorted(set(getattr(self, name))))
            object.__setattr__(self, name, values)
            if not values:
                raise InputError("none is given", where=name)
            if not least <= values[0] or not values[-1] < np.inf:
                raise InputError(f"{values[0]:g} is less than {least}", where=name)
        for name, least in (("seed", 0), ("max_models", 1), ("shape_sigma", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{value} is less than {least}", where=name)


@dataclass(frozen=True)
class RetrievalTask:
    """One view of one model, with so much noise and so many keypoints."""

    category: str
    model_id: str
    noise_px: float
    keypoints: int


def retrieval_tasks(library: Library, options: RetrievalEvaluation) -> list[RetrievalTask]:
    """Every model with every noise and number of keypoints that it has, those of a model together.

    Raises
    ------
    InputError
        If a category is unknown, or no model has so many keypoints.
    """
    from cadalign.datasets.categories import require_category

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


@dataclass(frozen=True)
class RetrievalExperiment:
    """Evaluates retrieval from a saved library.

    Parameters
    ----------
    library : str
        The library's file, which all workers map into memory.
    options : RetrievalEvaluation
    """

    library: str
    options: RetrievalEvaluation

    @property
    def columns(self) -> Columns:
        """The columns of the result table; see `RetrievalOutcome`."""
        return RetrievalOutcome.columns()

    @property
    def timing_columns(self) -> Columns:
        """What names the row, and the seconds of the retrieval."""
        return (*RetrievalOutcome.columns()[:6], ("seconds", float))

    def warm_up(self) -> None:
        """Compile the kernels."""
        rng = np.random.default_rng(0)
        models = [
            LibraryModel("box", str(k), rng.uniform(-0.3, 0.3, (9, 3)), np.arange(9), _UNIT_BOUNDS)
            for k in range(3)
        ]
        pose = Alignment(np.eye(3), np.array([0.0, 0.0, 2.0]), np.ones(3))
        pixels = KEYPOINT_CAMERA.project(pose.apply(models[0].xyz))
        Library.from_models(models).retrieve(pixels, np.arange(9), KEYPOINT_CAMERA)

    def evaluate(self, tasks: Sequence[RetrievalTask]) -> Result:
        """A row for every task, protocol and method."""
        return Result.joined([self._evaluate_one(task) for task in tasks])

    def failure(self, task: RetrievalTask, reason: str) -> Result:
        """A failed row for every protocol and method."""
        return self._without_match(task, FAILED, reason)

    def _without_match(self, task: RetrievalTask, status: str, reason: str) -> Result:
        outcomes = [
            RetrievalOutcome(**asdict(task), protocol=p, method=m, status=status, reason=reason)
            for p in self.options.protocols
            for m in self.options.methods
        ]
        return Result(
            [asdict(o) for o in outcomes], [{**o.key(), "seconds": None} for o in outcomes]
        )

    def _evaluate_one(self, task: RetrievalTask) -> Result:
        library = _opened(self.library)
        gt = library[task.category, task.model_id]
        try:
            query = observe_model(gt, task, seed=self.options.seed)
        except DegenerateError as error:
            return self._without_match(task, NO_VIEW, str(error))
        alike = same_shapes(self.library, gt.key)
        rows, timings = [], []
        for protocol in self.options.protocols:
            for method in self.options.methods:
                labels = {**asdict(task), "protocol": protocol, "method": method}
                start = time.perf_counter()
                try:
                    matches = library.retrieve(
                        query.points_2d,
                        query.semantic_ids,
                        query.camera,
                        top=TOP,
                        category=None if self.options.whole_library else task.category,
                        sigma=max(task.noise_px, _LEAST_SIGMA),
                        shape_sigma=self._shape_sigma(protocol, method),
                        exclude=alike if protocol == LEAVE_OUT else (),
                        workers=1,
                        **METHODS[method],
                    )
                    seconds: float | None = time.perf_counter() - start
                    best = library[matches[0].category, matches[0].model_id]
                    outcome = RetrievalOutcome.of_matches(
                        matches, best=best, gt=gt, placed=query.gt, alike=alike, **labels
                    )
                except CadalignError as error:
                    seconds = None
                    outcome = RetrievalOutcome(**labels, status=FAILED, reason=reason_of(error))
                rows.append(asdict(outcome))
                timings.append({**outcome.key(), "seconds": seconds})
        return Result(rows, timings)

    def _shape_sigma(self, protocol: str, method: str) -> float:
        exact = protocol == LEAVE_IN and method == "optimal"
        return 0.0 if exact else self.options.shape_sigma


@dataclass(frozen=True, eq=False)
class RetrievalQuery:
    """What one image shows of a stretched model.

    Parameters
    ----------
    points_2d : (n, 2) float
        Noisy keypoints [px].
    semantic_ids : (n,) int
    camera : Camera
    gt : Alignment
        The model's true pose and stretch.
    """

    points_2d: FloatArray
    semantic_ids: IntArray
    camera: Camera
    gt: Alignment


def observe_model(model: LibraryModel, task: RetrievalTask, *, seed: int) -> RetrievalQuery:
    """Stretch a model, draw a view of it, and hand over some of its visible keypoints.

    Everything random follows from the seed and the task. Which keypoints are seen follows from the
    keypoints alone; see `cadalign.evaluation.hull`.

    Raises
    ------
    DegenerateError
        If no view shows enough keypoints.
    """
    rng = instance_rng(seed, task.category, task.model_id, repr(task.noise_px), str(task.keypoints))
    stretch = np.array([1.0, *rng.uniform(*STRETCH_RANGE, 2)])
    hull = KeypointHull(model.xyz * stretch)
    pose, visible = sample_hull_view(hull, KEYPOINT_CAMERA, rng=rng, min_visible=task.keypoints)
    chosen = np.sort(rng.choice(np.flatnonzero(visible), task.keypoints, replace=False))
    pixels = KEYPOINT_CAMERA.project(pose.apply(hull.xyz[chosen]))
    return RetrievalQuery(
        points_2d=pixels + task.noise_px * rng.standard_normal(pixels.shape),
        semantic_ids=model.semantic_ids[chosen],
        camera=KEYPOINT_CAMERA,
        gt=Alignment(pose.rotation, pose.translation, stretch),
    )


@lru_cache(maxsize=64)
def same_shapes(library: str, key: ModelKey) -> frozenset[ModelKey]:
    """The models of a library's file that count as the given one, itself among them."""
    groups = _by_keypoints(library)
    gt = _opened(library)[key]
    keys, xyz = groups[gt.category, tuple(gt.semantic_ids.tolist())]
    near = distances(xyz, gt.xyz) <= SAME_SHAPE
    return frozenset([key, *(keys[k] for k in np.flatnonzero(near).tolist())])


@lru_cache(maxsize=2)
def _opened(library: str) -> Library:
    return Library.open(library)


@lru_cache(maxsize=2)
def _by_keypoints(
    library: str,
) -> dict[tuple[str, tuple[int, ...]], tuple[list[ModelKey], FloatArray]]:
    """Names and keypoints of the models with the same set of keypoints."""
    groups: dict[tuple[str, tuple[int, ...]], list[LibraryModel]] = {}
    for model in _opened(library):
        groups.setdefault((model.category, tuple(model.semantic_ids.tolist())), []).append(model)
    return {
        ids: ([model.key for model in models], np.array([model.xyz for model in models]))
        for ids, models in groups.items()
    }


def run_retrieval(
    root: str | os.PathLike[str],
    options: RetrievalEvaluation,
    folder: RunFolder,
    *,
    workers: int = -1,
    dask: str | None = None,
    on_progress: Callable[[Progress], object] = lambda progress: None,
) -> None:
    """Evaluate retrieval in a run's folder, or what is left of it.

    Parameters
    ----------
    root : str or path-like
        Folder in KeypointNet's layout, or a library's file.
    options : RetrievalEvaluation
    folder : RunFolder
        Gets the library as ``library.cadalign``.
    workers, dask
        See `cadalign.evaluation.run.workers_of`.
    on_progress : callable
        Told of every chunk.

    Raises
    ------
    InputError
        If a category is unknown.
    DataError
        If there are no models, or the folder holds another run.
    """
    library = _library_of(Path(root), options)
    tasks = retrieval_tasks(library, options)
    pool = workers_of(workers, dask=dask)
    folder.make()
    file = folder.path / "library.cadalign"
    if not file.exists():  # another run's, which is to be refused, stays as it is
        library.save(file)
    execute(
        RetrievalExperiment(str(file.absolute()), options),
        tasks,
        folder,
        config={
            "experiment": "retrieval",
            "root": str(Path(root).absolute()),
            "library": library.fingerprint[:16],
            **asdict(options),
        },
        chunk_size=_CHUNK,
        workers=pool,
        on_progress=on_progress,
    )


def _library_of(root: Path, options: RetrievalEvaluation) -> Library:
    """The library at a place, or one of the data set there."""
    from cadalign.datasets import KeypointNet

    if root.is_file():
        return Library.open(root)
    categories = None if options.whole_library else options.categories
    return Library.from_dataset(KeypointNet(root), categories=categories)


_UNIT_BOUNDS = np.array([[-0.3] * 3, [0.3] * 3])
