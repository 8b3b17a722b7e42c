"""Queries of the retrieval experiment: tasks, and views of stretched models."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets.models.categories import require_category
from cadalign.errors import InputError
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, STRETCH_RANGE
from cadalign.evaluation.retrieval.options import RetrievalRunOptions
from cadalign.evaluation.runs.tables import Row
from cadalign.geometry.alignment import Alignment
from cadalign.retrieval.models import LibraryModel
from cadalign.seeding import instance_rng

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library


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
    semantic_ids: IntArray
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
        semantic_ids=model.semantic_ids[chosen],
        gt=Alignment(pose.rotation, pose.translation, stretch),
    )
