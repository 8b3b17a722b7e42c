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

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DegenerateError
from cadalign.evaluation.accuracy.outcome import FAILED
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.retrieval.outcome import (
    LEAVE_IN,
    LEAVE_OUT,
    NO_VIEW,
    RetrievalOutcome,
)
from cadalign.evaluation.retrieval.tasks import (
    METHODS,
    RetrievalEvaluation,
    RetrievalTask,
    observe_model,
    retrieval_tasks,
)
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.run import Progress, execute, workers_of
from cadalign.evaluation.runs.work import Columns, Result, reason_of
from cadalign.geometry.alignment import Alignment
from cadalign.retrieval.library import Library
from cadalign.retrieval.models import LibraryModel, ModelKey
from cadalign.retrieval.shape import SAME_SHAPE, distances

TOP = 50
"""Ranks beyond this are not told apart."""
_LEAST_SIGMA = 0.5  # keypoints without noise would leave no other model any chance
# Part of a run's configuration: another size would cut a half-done run into other chunks.
_CHUNK = 16


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
        See `cadalign.evaluation.runs.run.workers_of`.
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
    name = library.fingerprint[:16]
    claimed = folder.read_config()
    # One that no run.json speaks of is from a run that died before it began, perhaps another's; the
    # library of another run, which is to be refused, stays as it is.
    if claimed is None or claimed.get("library") == name:
        library.save(file)
    execute(
        RetrievalExperiment(str(file.absolute()), options),
        tasks,
        folder,
        config={
            "experiment": "retrieval",
            "root": str(Path(root).absolute()),
            "library": name,
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
