"""The queries of the retrieval experiment: how to make them, which there are, what they hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, STRETCH_RANGE
from cadalign.evaluation.retrieval.outcome import PROTOCOLS
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.seeding import instance_rng

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.models import LibraryModel

METHODS: dict[str, dict[str, Any]] = {
    "optimal": {},
    "optimal-unstretched": {"stretch": "none"},
    "epnp": {"method": "epnp"},
}
"""What can be evaluated, with the options of `cadalign.Library.retrieve`."""


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
    from cadalign.datasets.models.categories import require_category

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
    keypoints alone; see `cadalign.evaluation.instances.hull`.

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
