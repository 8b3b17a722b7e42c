"""The tasks of the experiment on unseen objects: one for each view of each object."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.runs.tables import Row
from cadalign.evaluation.unseen.options import UnseenOptions
from cadalign.geometry.alignment import Alignment
from cadalign.seeding import instance_rng


@dataclass(frozen=True, eq=False)
class UnseenTask:
    """One view of one object.

    Parameters
    ----------
    xyz : (k, 3) float
        All keypoints of the object [diagonals].
    semantic_ids : (k,) int
    problem : str
        Reason why the object cannot be evaluated; empty otherwise.
    """

    category: str
    model_id: str
    view: int
    xyz: FloatArray
    semantic_ids: IntArray
    problem: str = ""

    @property
    def names(self) -> Row:
        """The cells that name its rows, but for the method."""
        return {"category": self.category, "model_id": self.model_id, "view": self.view}


class UnseenTasks(Sequence[UnseenTask]):
    """All views of all objects in the order of their names, made when asked for."""

    def __init__(self, dataset: KeypointNet, options: UnseenOptions) -> None:
        self._dataset = dataset.subset(categories=options.categories, split=options.split)
        self._views = options.views_per_model
        self._keys = [
            key
            for category in self._dataset.categories
            for key in sorted(self._dataset.ids(category))[: options.max_models]
        ]
        if not self._keys:
            raise DataError(f"no objects in the split {options.split}", where=str(dataset.root))

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories that have objects, sorted."""
        return tuple(sorted({category for category, _ in self._keys}))

    def __len__(self) -> int:
        return len(self._keys) * self._views

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place, view = divmod(range(len(self))[index], self._views)
        category, model_id = self._keys[place]
        try:
            keypoints = self._dataset[category, model_id].keypoints
        except CadalignError as error:
            none = np.empty(0, dtype=np.int64)
            return UnseenTask(category, model_id, view, np.empty((0, 3)), none, str(error))
        return UnseenTask(category, model_id, view, keypoints.xyz, keypoints.semantic_ids)

    def fingerprint(self) -> str:
        """Hash of the annotations: a run must not go on with others."""
        digest = hashlib.sha256()
        for place in range(len(self._keys)):
            task = self[place * self._views]
            digest.update(f"{task.category}\0{task.model_id}\0{task.problem}".encode())
            digest.update(task.xyz.tobytes() + task.semantic_ids.tobytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class UnseenSighting:
    """Content of a view of an object, and the truth.

    Parameters
    ----------
    points_2d : (n, 2) float
        The given keypoints [px], with noise and outliers.
    semantic_ids : (n,) int
    rows : (n,) int
        Their rows among all keypoints of the object.
    is_outlier : (n,) bool
    gt : Alignment
        The object's pose; its scale is 1.
    xyz, all_ids
        All keypoints of the object.
    """

    points_2d: FloatArray
    semantic_ids: IntArray
    rows: IntArray
    is_outlier: BoolArray
    gt: Alignment
    xyz: FloatArray
    all_ids: IntArray

    @property
    def bounds(self) -> FloatArray:
        """The least and greatest coordinates of the object's keypoints, (2, 3) float."""
        return np.array([self.xyz.min(axis=0), self.xyz.max(axis=0)])


def observe_object(task: UnseenTask, options: UnseenOptions) -> UnseenSighting:
    """Draw a view of an object, the keypoints that are given, their noise and outliers.

    Views are those of `sample_hull_view`; hidden keypoints may be given, too. Everything random
    follows from (seed, category, model id, view): view, order of keypoints and unit noise are the
    same whatever the noise and the number of keypoints.
    """
    if task.problem:
        raise DataError(task.problem)
    names = (task.category, task.model_id, str(task.view))
    count = len(task.xyz)
    gt, _ = sample_hull_view(
        KeypointHull(task.xyz),
        KEYPOINT_CAMERA,
        rng=instance_rng(options.seed, *names),
        min_visible=0,
    )
    rng = instance_rng(options.seed, *names, "keypoints")
    order, noise = rng.permutation(count), rng.standard_normal((count, 2))
    elsewhere = rng.uniform(0, (KEYPOINT_CAMERA.width, KEYPOINT_CAMERA.height), (count, 2))
    given = order[: options.keypoints]
    rows = np.sort(given)
    is_outlier = np.isin(rows, given[: round(options.outliers * len(given))])
    clean = KEYPOINT_CAMERA.project(gt.apply(task.xyz[rows]))
    points = clean + options.noise_px * noise[rows]
    points[is_outlier] = elsewhere[rows][is_outlier]
    return UnseenSighting(
        points, task.semantic_ids[rows], rows, is_outlier, gt, task.xyz, task.semantic_ids
    )
