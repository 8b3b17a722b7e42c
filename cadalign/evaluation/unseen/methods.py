"""Estimates of the compared methods, in one form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DegenerateError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.accuracy.cramer_rao import limit_estimate
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.unseen.learned import LearnedFiles
from cadalign.evaluation.unseen.options import (
    EXACT,
    LIMIT,
    MEAN_RIGID,
    NEAREST,
    RANDOM_RIGID,
    SHAPE,
    UnseenOptions,
)
from cadalign.evaluation.unseen.tasks import UnseenSighting, UnseenTask
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
    """Pose and shape of an object as a method found them.

    Parameters
    ----------
    alignment : Alignment
    bounds : (2, 3) float
        Least and greatest coordinates before the stretch.
    ids : (m,) int
    points_3d : (m, 3) float
        Keypoints before the stretch.
    result : Result, optional
        With the covariances; None for methods that have none.
    """

    alignment: Alignment
    bounds: FloatArray
    ids: IntArray
    points_3d: FloatArray
    result: Result | None = None

    @property
    def poses(self) -> tuple[Alignment, ...]:
        """The alignment, and the alternatives to it."""
        others = () if self.result is None else self.result.alternatives
        return (self.alignment, *(other.alignment for other in others))


def estimate_shape(
    method: str,
    task: UnseenTask,
    sighting: UnseenSighting,
    learned: LearnedFiles,
    options: UnseenOptions,
) -> ShapeEstimate:
    """The estimate of a method; raises CadalignError where it has none."""
    if method == LIMIT:
        return _bound(sighting)
    if method == NEAREST:
        return _nearest(task, sighting, learned, options)
    shape = learned.shape(task.category)
    if method == SHAPE:
        return _aligned(shape, sighting, options, misfit_px=0.0)
    if method == EXACT:
        own = Model(points_3d=sighting.xyz, ids=sighting.all_ids.tolist())
        return _aligned(own, sighting, options, misfit_px=0.0)
    stretch = "none" if method in (RANDOM_RIGID, MEAN_RIGID) else None
    if method.startswith("mean"):
        rows = shape.mean
        model = Model(points_3d=rows[:-2], ids=shape.ids, bounds=rows[-2:], stretch=stretch)
    else:
        other = _random_model(task, sighting, learned, options)
        ids = other.semantic_ids.tolist()
        model = Model(points_3d=other.xyz, ids=ids, bounds=other.bounds, stretch=stretch)
    return _aligned(model, sighting, options, misfit_px=_MISFIT_PX)


def _aligned(
    model: Model | ShapeModel, sighting: UnseenSighting, options: UnseenOptions, *, misfit_px: float
) -> ShapeEstimate:
    """Align a model with those given keypoints that it has."""
    sigma = options.noise_px or 1.0
    ids = np.array(model.ids, dtype=np.int64)
    shared = np.isin(sighting.semantic_ids, ids)
    view = View(
        KEYPOINT_CAMERA,
        sighting.points_2d[shared],
        ids=sighting.semantic_ids[shared].tolist(),
        sigma=sigma,
    )
    bound = max(_INLIER_BOUND * sigma, misfit_px)
    ransac = RansacOptions(max_reproj_error=bound) if options.outliers else None
    result = align(model, view, ransac=ransac)
    return ShapeEstimate(result.alignment, result.bounds, ids, result.points_3d, result)


def _nearest(
    task: UnseenTask, sighting: UnseenSighting, learned: LearnedFiles, options: UnseenOptions
) -> ShapeEstimate:
    library = learned.opened_library()
    first = library.retrieve(
        sighting.points_2d,
        sighting.semantic_ids,
        KEYPOINT_CAMERA,
        top=1,
        category=task.category,
        sigma=max(options.noise_px, _LEAST_SIGMA),
        shape_sigma=_SIMILAR,
        loss="cauchy" if options.outliers else "linear",
        workers=1,
    )[0]
    model = library[first.category, first.model_id]
    return ShapeEstimate(first.alignment, first.bounds, model.semantic_ids, model.xyz)


def _random_model(
    task: UnseenTask, sighting: UnseenSighting, learned: LearnedFiles, options: UnseenOptions
) -> LibraryModel:
    """A random model of the category, among those that share enough keypoints with the image."""
    library = learned.opened_library()
    keys = [key for key in library.keys if key[0] == task.category]
    names = (task.category, task.model_id, str(task.view))
    rng = instance_rng(options.seed, *names, "another model")
    least = min(_LEAST_SHARED, len(sighting.semantic_ids))
    for place in rng.permutation(len(keys)).tolist():
        model = library[keys[place]]
        if np.isin(sighting.semantic_ids, model.semantic_ids).sum() >= least:
            return model
    raise DegenerateError(f"no other model has {least} of the keypoints", where="keypoints")


def _bound(sighting: UnseenSighting) -> ShapeEstimate:
    """The ideal estimate with the object's own model from the keypoints that are no outliers."""
    kept = ~sighting.is_outlier
    alignment = limit_estimate(
        sighting.xyz[sighting.rows[kept]], sighting.points_2d[kept], KEYPOINT_CAMERA, sighting.gt
    )
    return ShapeEstimate(alignment, sighting.bounds, sighting.all_ids, sighting.xyz)
