"""Retrieval: times of queries, and accuracy for objects outside of the library."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Box, Library, View
from cadalign.datasets import KeypointNet
from cadalign.evaluation.experiments.retrieval import (
    RetrievalQuery,
    RetrievalTask,
    observe_model,
    same_shapes,
)
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.metrics import box_iou_up_to_scale
from cadalign.retrieval import LibraryModel, Match

_KEYPOINTS = 8
_CALLS = 3
_LEAST_SHARED = 4
_FLAT = 1e-9
_NOISE_PX = 2.0  # of unseen objects
_CATEGORIES = ("chair", "airplane", "bottle", "mug", "guitar")


def retrieval(given: BenchmarkData) -> Tables:
    """Times of queries, and accuracy for objects outside of the library."""
    yield from _times(given)
    yield "First matches", _unseen(given)


def _times(given: BenchmarkData) -> Tables:
    """Times of queries among real models, and in growing synthetic libraries.

    Synthetic models are real ones with keypoints moved by 3 % of the extent. Queries compare models
    of all categories. Times are the minimum of three calls after warm-up, with one thread per core.
    """
    real = list(Library.from_models(KeypointNet(given.folder("keypointnet"))))
    mixed = [real[k] for k in np.random.default_rng(0).permutation(len(real)).tolist()]
    for size in (len(real), *given.sizes):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "library")
            _jitter(mixed, size).save(path)
            title = f"Queries among {size:,} models, {path.stat().st_size / 1e6:.1f} MB"
            yield title, _queries(path, mixed[:size], given.count or 20)


def _queries(path: Path, models: Sequence[LibraryModel], count: int) -> Iterator[Row]:
    opening, _, library = section.clock(partial(Library.open, path))
    yield {"call": "opening", "median ms": 1e3 * opening}
    shown = [model for model in models if len(model.xyz) >= _KEYPOINTS]
    for noise_px in (1.0, 3.0, 5.0):
        calls = [
            partial(library.retrieve, seen.points_2d, seen.ids, KEYPOINT_CAMERA, sigma=noise_px)
            for seen in islice(_observe(shown, noise_px, seed=0), count)
        ]
        calls[0]()  # warm-up
        times = [1e3 * min(section.clock(call)[0] for _ in range(_CALLS)) for call in calls]
        name = f"query, {noise_px:g} px"
        yield {"call": name, "median ms": float(np.median(times)), "longest ms": max(times)}


def _jitter(models: Sequence[LibraryModel], count: int) -> Library:
    rng = np.random.default_rng(0)
    filled = list(models[:count])
    while len(filled) < count:
        model = models[len(filled) % len(models)]
        extent = np.linalg.norm(np.ptp(model.xyz, axis=0))
        xyz = model.xyz + 0.03 / np.sqrt(3) * extent * rng.standard_normal(model.xyz.shape)
        name = f"{model.model_id}-{len(filled)}"
        filled.append(replace(model, model_id=name, xyz=xyz, mesh_path=None))
    return Library.from_models(filled)


def _observe(
    models: Sequence[LibraryModel], noise_px: float, *, seed: int
) -> Iterator[RetrievalQuery]:
    for model in models:
        task = RetrievalTask(*model.key, noise_px, _KEYPOINTS)
        seen = section.attempt(observe_model, model, task, seed=seed)
        if seen is not None:
            yield seen


def _unseen(given: BenchmarkData) -> Iterator[Row]:
    """Box IoU up to scale of the first match, for objects outside of the library.

    Objects are from the split val, with all keypoints and 2 px of noise; shape models are learned
    from the split train. The library lacks the object's own model and all models that equal it
    after a stretch. Models are ranked by their fit, exact or with an uncertain shape, or by the
    estimated shape. Boxes enclose the keypoints.
    """
    root = given.folder("keypointnet")
    for category in _CATEGORIES:
        shape = section.learned_shape(root, category)
        without_mesh = partial(LibraryModel.from_annotated, with_mesh=False)
        library = Library.from_models(list(map(without_mesh, KeypointNet(root)[category])))
        how = {"keypoints": None, "noise_px": _NOISE_PX}
        cases = []
        for _, seen in section.unseen_objects(root, category, given.count or 40, **how):
            box, view = Box.from_model(seen.task.hull.bounds, seen.gt), seen.view_of(shape)
            if len(view.ids or ()) >= _LEAST_SHARED and box.volume >= _FLAT:
                same = same_shapes(library, (category, seen.task.model_id))
                cases.append(({"category": category}, (view, box, same)))
        rankings = {"fit": {}, "fit, shape_sigma": {"shape_sigma": 0.02}, "shape": {"shape": shape}}
        methods = {
            name: partial(_first_iou, partial(library.retrieve, category=category, **options))
            for name, options in rankings.items()
        }
        yield from section.summaries(section.measure(cases, methods), "category", "method")


def _first_iou(retrieve: Callable[..., list[Match]], case: tuple[View, Box, Any]) -> Row:
    """IoU of the first match of a query; 0 without a match, or if its box is flat."""
    view, gt, same = case
    seen = view.points_2d, view.ids, KEYPOINT_CAMERA
    how: Row = {"top": 1, "sigma": _NOISE_PX, "exclude": same, "workers": 1}
    matches = section.attempt(retrieve, *seen, **how)
    if not matches or matches[0].box.volume < _FLAT:
        return {"IoU": 0.0}
    return {"IoU": section.attempt(box_iou_up_to_scale, est=matches[0].box, gt=gt) or 0.0}
