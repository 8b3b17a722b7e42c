"""Coverage of stated uncertainties, and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Camera, Model, RansacOptions, ShapeModel, View
from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.metrics.errors import probability_level
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.metrics import rotation_error

_KINDS = ("fit", "sigma=None", "20 % outliers", "focal", "shape_sigma=.05", "two views")
_SIZES = (5, 6, 8, 12, 30, 100, 200)
_SHAPE_SIGMA = 0.05
_STRETCH_SIGMA = 0.2
_NOISE_PX = 1.0


def coverage(given: BenchmarkData) -> Tables:
    """Coverage of stated uncertainties for random objects in a unit cube, 1 px; and warnings."""
    yield "Truths inside regions of 68 and 95 % [%]", _regions(given.seed, given.count or 150)
    yield from _warnings(given)


def _regions(seed: int, count: int) -> Iterator[Row]:
    methods = {kind: partial(_coverage, kind=kind) for kind in _KINDS}
    for points in _SIZES:
        cases = (({"keypoints": points}, (seed, points, number)) for number in range(count))
        yield from section.summaries(section.measure(cases, methods), "method", "keypoints")


def _coverage(stream: tuple[int, int, int], *, kind: str) -> Row:
    """Tell if the regions of rotation, translation and lengths hold the truth, for one estimate."""
    rng, points = np.random.default_rng(stream), stream[1]
    model = rng.uniform(-0.5, 0.5, (points, 3))
    scale = np.array([1.0, *np.exp(rng.normal(0, _STRETCH_SIGMA, 2))])
    differs = _SHAPE_SIGMA if kind.startswith("shape_sigma") else 0.0
    object_points = model * scale + rng.normal(0, 1, model.shape) * differs
    camera, poses = KEYPOINT_CAMERA, list[Alignment]()
    for _ in range(2):
        turn = Rotation.random(random_state=rng).as_matrix()
        shift = rng.uniform((-0.3, -0.2, 3.0), (0.3, 0.2, 5.0))
        poses.append(Alignment(turn, shift, np.ones(3)))
    seen = [camera.project(each.apply(object_points)) for each in poses]
    for pixels in seen:
        pixels += rng.normal(0, _NOISE_PX, pixels.shape)
    truth = replace(poses[0], scale=scale)
    options = dict[str, Any](sigma=_NOISE_PX)
    if kind == "sigma=None":
        options = {"sigma": None}
    elif kind == "20 % outliers":
        wrong = rng.choice(points, points // 5, replace=False)
        seen[0][wrong] = rng.uniform(0, (640, 480), (len(wrong), 2))
        options["ransac"] = RansacOptions()
    elif kind == "focal":
        camera, options["focal"] = Camera.from_size(640, 480), "estimate"
    if kind == "two views" or differs:
        views = [View(camera, each, sigma=_NOISE_PX) for each in seen]
        own = Model(points_3d=model, shape_sigma=differs) if differs else Model(points_3d=model)
        result = cadalign.align(own, views[:1] if differs else views)
    else:
        result = cadalign.fit(model, seen[0], camera, **options)
    error, covariance = section.deviation(est=result.alignment, gt=truth), result.covariance
    row: Row = {}
    for first, name in ((0, "R"), (3, "t"), (6, "lengths")):
        part, freedom = slice(first, first + 3), result.degrees_of_freedom
        level = probability_level(error[part], covariance[part, part], freedom)
        row |= {f"{name} {p:.0%}": level is not None and level <= p for p in (0.68, 0.95)}
    return row


# Warnings -----------------------------------------------------------------------------------------

_WARNED_PX = 2.0
_DISPLACED = 0.02  # of keypoints [diagonals]
_LEAST_KEYPOINTS = 6
_MOVED_PX = 40.0
_LARGE_DEG, _REGION = 10.0, 0.999


class _Case(NamedTuple):
    """Input of `align`: model, noisy keypoints with ids, camera and options; and the true pose."""

    model: Model | ShapeModel
    ids: list[int]
    points_2d: FloatArray
    gt: Alignment
    camera: Camera = KEYPOINT_CAMERA
    options: Mapping[str, Any] = MappingProxyType({})


def _warnings(given: BenchmarkData) -> Tables:
    """Rates of warnings on correct and on faulty data, with objects of KeypointNet's split val.

    Models are the object's own model, stretched; the same with displaced keypoints; and the shape
    learned from the split train. An error is silent if there is no warning, the rotation error of
    the estimate and of every alternative exceeds 10 degrees, and the truth is outside the stated
    99.9 % region.
    """
    cases = _cases(given, given.count or 40)
    rows = section.measure(cases, {"align": _outcome})
    yield "Correct and faulty data [%]", section.summaries(rows, "mistake", "model")


def _cases(given: BenchmarkData, count: int) -> Iterator[tuple[Row, _Case]]:
    """All objects with all models and mistakes."""
    root = given.folder("keypointnet")
    categories = list(KeypointNet(root).categories)
    for category, other in zip(categories, (categories[-1], *categories), strict=False):
        shape, foreign = (section.learned_shape(root, name) for name in (category, other))
        how = {"noise_px": _WARNED_PX, "max_models": count}
        for place, seen in section.unseen_objects(root, category, count, **how):
            if len(seen.ids) < _LEAST_KEYPOINTS:
                continue
            rng = instance_rng(0, category, str(place), "warned")
            for name, case in _models(seen, shape, rng).items():
                for mistake, changed in _mistakes(case, foreign, rng):
                    yield {"mistake": mistake, "model": name}, changed


def _models(seen: UnseenObject, shape: ShapeModel, rng: np.random.Generator) -> dict[str, _Case]:
    """Correct data of an object, by model and options."""
    points, ids = seen.xyz[seen.rows], seen.ids.tolist()
    stretched = points / np.exp(np.append(0.0, rng.normal(0, _STRETCH_SIGMA, 2)))
    moved = stretched + rng.normal(0, _DISPLACED, points.shape)
    how: dict[str, Any] = {"shape_sigma": _DISPLACED, "stretch_sigma": _STRETCH_SIGMA}
    own = _Case(Model(points_3d=stretched, ids=ids), ids, seen.points_2d, seen.gt)
    known = np.isin(ids, shape.ids)
    of_shape = own._replace(
        model=shape, ids=seen.ids[known].tolist(), points_2d=seen.points_2d[known]
    )
    robust = {"ransac": RansacOptions()}
    unknown = {"camera": Camera.from_size(640, 480), "options": {"focal": "estimate"}}
    return {
        "own": own,
        "own, RANSAC": own._replace(options=robust),
        "own, unknown focal length": own._replace(**unknown),
        "similar": own._replace(model=Model(points_3d=moved, ids=ids, **how)),
        "learned": of_shape,
        "learned, RANSAC": of_shape._replace(options=robust),
    }


def _mistakes(
    case: _Case, foreign: ShapeModel, rng: np.random.Generator
) -> Iterator[tuple[str, _Case]]:
    """The unchanged case, and the case with each mistake."""
    yield "none", case
    pixels, last = case.points_2d, np.subtract((640, 480), 2 * PIXEL_CENTRE)
    row, angle = int(rng.integers(len(pixels))), rng.uniform(0, 2 * np.pi)
    moved = pixels.copy()
    moved[row] += _MOVED_PX * np.array([np.cos(angle), np.sin(angle)])
    gaps = np.linalg.norm(pixels[:, None] - pixels, axis=2)
    pairs = np.argwhere(gaps > _MOVED_PX)
    changed = {
        "one keypoint 40 px off": moved,
        "u from the right": pixels * [-1, 1] + [last[0], 0],
        "v from the bottom": pixels * [1, -1] + [0, last[1]],
        "u and v exchanged": pixels[:, ::-1].copy(),
    }
    if len(pairs):
        swapped, pair = pixels.copy(), pairs[rng.integers(len(pairs))]
        swapped[pair] = swapped[pair[::-1]]
        changed["two keypoints exchanged"] = swapped
    for name, each in changed.items():
        yield name, case._replace(points_2d=each)
    if isinstance(case.model, ShapeModel):
        count = min(len(pixels), len(foreign.ids))
        ids = list(foreign.ids[:count])
        yield "another category", case._replace(model=foreign, ids=ids, points_2d=pixels[:count])


def _outcome(case: _Case) -> Row:
    """Tell if an estimate has a warning, and if it is silently wrong."""
    view = View(case.camera, case.points_2d, ids=case.ids, sigma=_WARNED_PX)
    result = cadalign.align(case.model, view, **case.options)
    poses = [result.alignment, *(each.alignment for each in result.alternatives)]
    off = [rotation_error(est=pose, gt=case.gt) > _LARGE_DEG for pose in poses]
    turn = section.deviation(est=result.alignment, gt=case.gt)[:3]
    level = probability_level(turn, result.covariance[:3, :3], result.degrees_of_freedom)
    is_warned = bool(result.warnings)
    beyond = level is not None and level > _REGION
    return {"warned": is_warned, "silent": all(off) and beyond and not is_warned}
