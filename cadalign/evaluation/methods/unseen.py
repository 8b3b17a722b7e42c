"""Methods on unseen objects: other models, the mean shape, the shape model, the object's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.errors import DegenerateError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, KeypointTask
from cadalign.evaluation.methods.method import LIMIT, SHAPE, Method
from cadalign.evaluation.metrics.cramer_rao import limit_estimate
from cadalign.evaluation.shape_files import LearnedFiles
from cadalign.geometry.alignment import Alignment
from cadalign.retrieval.models import LibraryModel
from cadalign.seeding import instance_rng
from cadalign.shapes.model import ShapeModel

_LEAST_SIGMA = 0.5  # of retrieval [px]: keypoints without noise would leave no model any chance
_SIMILAR = 0.02  # of retrieval: misfit of the best model, as a share of its extent
_INLIER_BOUND = 3.5  # standard deviations
_MISFIT_PX = 30.0  # a residual that another model of the category leaves
_LEAST_SHARED = 6


@dataclass(frozen=True, eq=False)
class ShapeEstimate:
    """Pose and shape of an object as a method found them."""

    alignment: Alignment
    bounds: FloatArray  # (2, 3), least and greatest coordinates before the stretch
    ids: IntArray  # (m,)
    points_3d: FloatArray  # (m, 3), keypoints before the stretch
    result: Result | None = None  # with the covariances; None for methods that have none

    @property
    def poses(self) -> tuple[Alignment, ...]:
        """The alignment, and the alternatives to it."""
        others = () if self.result is None else self.result.alternatives
        return (self.alignment, *(other.alignment for other in others))


@dataclass(frozen=True, eq=False)
class UnseenObject:
    """View of an object, whose scale is 1."""

    task: KeypointTask  # names and keypoints of the object
    gt: Alignment  # the pose
    rows: IntArray  # (n,), rows of the given keypoints among all of the object
    points_2d: FloatArray  # (n, 2), the given keypoints [px], with noise and outliers
    is_outlier: BoolArray  # (n,)

    @property
    def xyz(self) -> FloatArray:
        """All keypoints of the object, (k, 3) float."""
        return self.task.hull.xyz

    @property
    def ids(self) -> IntArray:
        """Semantic ids of the given keypoints, (n,) int."""
        return self.task.ids[self.rows]


@dataclass(frozen=True, eq=False)
class UnseenInstance:
    """A view of an object, what was learned of its category from others, and the run's options."""

    seen: UnseenObject
    learned: LearnedFiles
    seed: int
    noise_px: float  # standard deviation of the keypoints' noise [px]
    sigma: float  # the same as methods are given it [px]
    outliers: float  # share of wrong keypoints

    @property
    def shape(self) -> ShapeModel:
        """The shape model of the category."""
        return self.learned.shape(self.seen.task.category)

    def view_of(self, model: Model | ShapeModel) -> View:
        """Those given keypoints that a model has."""
        seen = self.seen
        shared = np.isin(seen.ids, np.array(model.ids, dtype=np.int64))
        ids = seen.ids[shared].tolist()
        return View(KEYPOINT_CAMERA, seen.points_2d[shared], ids=ids, sigma=self.sigma)


def _of_shape(instance: UnseenInstance) -> ShapeEstimate:
    return _aligned(instance.shape, instance)


def _of_own_model(instance: UnseenInstance) -> ShapeEstimate:
    seen = instance.seen
    return _aligned(Model(points_3d=seen.xyz, ids=seen.task.ids.tolist()), instance)


def _of_mean(instance: UnseenInstance, *, stretch: str | None) -> ShapeEstimate:
    shape = instance.shape
    rows = shape.mean
    model = Model(points_3d=rows[:-2], ids=shape.ids, bounds=rows[-2:], stretch=stretch)
    return _aligned(model, instance, misfit_px=_MISFIT_PX)


def _of_random_model(instance: UnseenInstance, *, stretch: str | None) -> ShapeEstimate:
    other = _random_model(instance)
    ids = other.ids.tolist()
    model = Model(points_3d=other.xyz, ids=ids, bounds=other.bounds, stretch=stretch)
    return _aligned(model, instance, misfit_px=_MISFIT_PX)


def _aligned(
    model: Model | ShapeModel, instance: UnseenInstance, *, misfit_px: float = 0.0
) -> ShapeEstimate:
    """Align a model with those given keypoints that it has."""
    bound = max(_INLIER_BOUND * instance.sigma, misfit_px)
    ransac = RansacOptions(max_reproj_error=bound) if instance.outliers else None
    result = align(model, instance.view_of(model), ransac=ransac)
    ids = np.array(model.ids, dtype=np.int64)
    return ShapeEstimate(result.alignment, result.bounds, ids, result.points_3d, result)


def _nearest(instance: UnseenInstance) -> ShapeEstimate:
    """The best match of the library."""
    library = instance.learned.opened_library()
    first = library.retrieve(
        instance.seen.points_2d,
        instance.seen.ids,
        KEYPOINT_CAMERA,
        top=1,
        category=instance.seen.task.category,
        sigma=max(instance.noise_px, _LEAST_SIGMA),
        shape_sigma=_SIMILAR,
        loss="cauchy" if instance.outliers else "linear",
        workers=1,
    )[0]
    model = library[first.category, first.model_id]
    return ShapeEstimate(first.alignment, first.bounds, model.ids, model.xyz)


def _random_model(instance: UnseenInstance) -> LibraryModel:
    """A random model of the category, among those that share enough keypoints with the image."""
    library, task = instance.learned.opened_library(), instance.seen.task
    given = instance.seen.ids
    keys = [key for key in library.keys if key[0] == task.category]
    names = (task.category, task.model_id, str(task.view))
    rng = instance_rng(instance.seed, *names, "another model")
    least = min(_LEAST_SHARED, len(given))
    for place in rng.permutation(len(keys)).tolist():
        model = library[keys[place]]
        if np.isin(given, model.ids).sum() >= least:
            return model
    raise DegenerateError(f"no other model has {least} of the keypoints", where="keypoints")


def _bound(instance: UnseenInstance) -> ShapeEstimate:
    """The ideal estimate with the object's own model from the keypoints that are no outliers."""
    seen = instance.seen
    kept = ~seen.is_outlier
    alignment = limit_estimate(
        seen.xyz[seen.rows[kept]], seen.points_2d[kept], KEYPOINT_CAMERA, seen.gt
    )
    return ShapeEstimate(alignment, seen.task.hull.bounds, seen.task.ids, seen.xyz)


_SOLVERS: dict[str, Callable[[UnseenInstance], ShapeEstimate]] = {
    "random-rigid": partial(_of_random_model, stretch="none"),
    "random-stretched": partial(_of_random_model, stretch=None),
    "nearest": _nearest,
    "mean-rigid": partial(_of_mean, stretch="none"),
    "mean-stretched": partial(_of_mean, stretch=None),
    SHAPE: _of_shape,
    "exact": _of_own_model,
    LIMIT: _bound,
}
OWN_METHODS = {name: Method(name, solve) for name, solve in _SOLVERS.items()}
"""The experiment's methods by name."""
