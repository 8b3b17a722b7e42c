"""Coverage of stated uncertainties, and warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, T, Tables, percent
from cadalign import Alignment, Camera, Model, RansacOptions, Result, ShapeModel, View
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
_SIMILAR_SIZES = (6, 12, 30, 60, 200)
_REGIONS = ("R", "t", "lengths")
_NOISE_PX = 1.0


def coverage(given: BenchmarkData) -> Tables:
    """Coverage of stated uncertainties, of random objects in a unit cube with 1 px; warnings."""
    count = given.count or 150
    yield "Truths within nominal 68, 95 %", _regions(given.seed, count)
    yield "Similar models, more and more keypoints", _similar(given.seed, count)
    yield from _warned(given)


def _regions(seed: int, count: int) -> Iterator[Row]:
    for kind in _KINDS:
        for points in _SIZES:
            draw = partial(_estimated, kind=kind, points=points)
            reached = [_levels(*each) for each in _estimates(draw, seed, points, count)]
            row: Row = {"estimate": kind, "keypoints": points, "results": len(reached)}
            if reached:  # not all were refused
                row |= dict(zip(_REGIONS, map(_within, np.transpose(reached)), strict=True))
            yield row


def _similar(seed: int, count: int) -> Iterator[Row]:
    for stretch in ("free", "none"):
        for shape_sigma in (0.01, 0.05, 0.1):
            for points in _SIMILAR_SIZES:
                how = {"shape_sigma": shape_sigma, "stretch": stretch, "points": points}
                draw = partial(_similar_estimate, **how)
                found = _estimates(draw, seed, points, count)
                bias, stated, turn, level = np.transpose(found)
                yield how | {
                    "log distance over stated": float(bias.mean() / np.sqrt((stated**2).mean())),
                    "R deg": float(np.median(turn)),
                    "t within 68, 95 %": _within(level),
                }


def _estimates(
    draw: Callable[[np.random.Generator], T], seed: int, points: int, count: int
) -> list[T]:
    """Draws and their estimates, without those that are refused."""
    drawn = (
        section.attempt(draw, np.random.default_rng([seed, points, number]))
        for number in range(count)
    )
    return [each for each in drawn if each is not None]


def _within(levels: FloatArray) -> str:
    return ", ".join(f"{percent(levels <= share):.0f}" for share in (0.68, 0.95))


def _placed(rng: np.random.Generator, scale: FloatArray) -> Alignment:
    """A random pose some units before the camera."""
    turn = Rotation.random(random_state=rng).as_matrix()
    return Alignment(turn, rng.uniform((-0.3, -0.2, 3.0), (0.3, 0.2, 5.0)), scale)


def _estimated(rng: np.random.Generator, *, kind: str, points: int) -> tuple[Result, Alignment]:
    model = rng.uniform(-0.5, 0.5, (points, 3))
    scale = np.array([1.0, *np.exp(rng.normal(0, _STRETCH_SIGMA, 2))])
    differs = _SHAPE_SIGMA if kind.startswith("shape_sigma") else 0.0
    object_points = model * scale + rng.normal(0, 1, model.shape) * differs
    camera, poses = KEYPOINT_CAMERA, [_placed(rng, np.ones(3)) for _ in range(2)]
    seen = [
        section.seen_in(camera, each, object_points, _NOISE_PX, rng).points_2d for each in poses
    ]
    truth = replace(poses[0], scale=scale)
    if kind == "two views" or differs:
        views = [View(camera, each, sigma=_NOISE_PX) for each in seen]
        own = Model(points_3d=model, shape_sigma=differs) if differs else Model(points_3d=model)
        return cadalign.align(own, views[:1] if differs else views), truth
    options = dict[str, Any](sigma=_NOISE_PX)
    if kind == "sigma=None":
        options = {"sigma": None}
    elif kind == "20 % outliers":
        wrong = rng.choice(points, points // 5, replace=False)
        seen[0][wrong] = rng.uniform(0, (640, 480), (len(wrong), 2))
        options["ransac"] = RansacOptions()
    elif kind == "focal":
        camera, options["focal"] = Camera.without_focal(640, 480), "estimate"
    return cadalign.fit(model, seen[0], camera, **options), truth


def _similar_estimate(
    rng: np.random.Generator, *, shape_sigma: float, stretch: str, points: int
) -> tuple[float, float, float, float]:
    """Error of the log distance and its standard deviation, rotation error, region of t.

    The truth is drawn from the priors that are stated.
    """
    model = rng.uniform(-0.5, 0.5, (points, 3))
    logs = rng.normal(0, _STRETCH_SIGMA, 2) if stretch == "free" else np.zeros(2)
    truth = _placed(rng, np.exp([0.0, *logs]))
    moved = model + rng.normal(0, shape_sigma, model.shape)
    seen = section.seen_in(KEYPOINT_CAMERA, truth, moved, _NOISE_PX, rng).points_2d
    prior: dict[str, Any] = (
        {"stretch_sigma": _STRETCH_SIGMA} if stretch == "free" else {"stretch": "none"}
    )
    own = Model(points_3d=model, shape_sigma=shape_sigma, **prior)
    result = cadalign.align(own, View(KEYPOINT_CAMERA, seen, sigma=_NOISE_PX))
    distance = np.linalg.norm(truth.translation)
    along = truth.translation / distance
    error = np.log(np.linalg.norm(result.alignment.translation) / distance)
    stated = np.sqrt(along @ result.covariance[3:6, 3:6] @ along) / distance
    _, level, _ = _levels(result, truth)
    return float(error), float(stated), rotation_error(est=result.alignment, gt=truth), level


def _levels(result: Result, truth: Alignment) -> list[float | None]:
    """Levels of the smallest regions of rotation, translation and lengths that hold the truth."""
    error, covariance = section.deviation(est=result.alignment, gt=truth), result.covariance
    parts = (slice(first, first + 3) for first in (0, 3, 6))
    freedom = result.degrees_of_freedom
    return [probability_level(error[part], covariance[part, part], freedom) for part in parts]


# Warnings -----------------------------------------------------------------------------------------

_WARNED_PX = 2.0
_DISPLACED = 0.02  # of keypoints [diagonals]
_LEAST_KEYPOINTS = 6
_MOVED_PX = 40.0
_LARGE_DEG, _REGION = 10.0, 0.999
_RIGHT = "none"


def _warned(given: BenchmarkData) -> Tables:
    """Warnings on right data and on mistakes, of objects of KeypointNet's split val.

    Models are the object's own one, stretched; the same with its keypoints displaced; and the shape
    that was learned from the split train. A mistake is silent if the rotation is more than 10
    degrees off, outside of the stated 99.9 % region, without a warning and without an alternative
    nearer than that.
    """
    dataset = KeypointNet(given.folder("keypointnet"))
    rows = list(_rows(dataset, given.count or 40))
    right = [row for row in rows if row["mistake"] == _RIGHT]
    wrong = [row for row in rows if row["mistake"] != _RIGHT]
    yield "Right data [%]", _shares(right, ("model", "category"), ("warned", "large", "silent"))
    yield "Mistakes [%]", _shares(wrong, ("mistake", "model"), ("warned", "silent"))


class _Case(NamedTuple):
    """A model, its noisy keypoints in a view by id, the object's pose, and options of `align`."""

    model: Model | ShapeModel
    ids: list[int]
    points_2d: FloatArray
    gt: Alignment
    camera: Camera = KEYPOINT_CAMERA
    options: Mapping[str, Any] = MappingProxyType({})


def _rows(dataset: KeypointNet, count: int) -> Iterator[Row]:
    """The outcome of every object, model and mistake."""
    categories = list(dataset.categories)
    for category, other in zip(categories, (categories[-1], *categories), strict=False):
        shape, foreign = (section.learned_shape(dataset, name) for name in (category, other))
        how = {"noise_px": _WARNED_PX, "max_models": count}
        for place, seen in section.unseen_objects(dataset, category, count, **how):
            if len(seen.ids) < _LEAST_KEYPOINTS:
                continue
            rng = instance_rng(0, category, str(place), "warned")
            for name, case in _cases(seen, shape, rng).items():
                for mistake, changed in _mistakes(case, foreign, rng):
                    row = section.attempt(_outcome, changed)
                    if row is not None:
                        yield {"category": category, "model": name, "mistake": mistake} | row


def _cases(seen: UnseenObject, shape: ShapeModel, rng: np.random.Generator) -> dict[str, _Case]:
    """The right data of an object by model and options."""
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
    unknown = {"camera": Camera.without_focal(640, 480), "options": {"focal": "estimate"}}
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
    """The case as it is, and with each mistake."""
    yield _RIGHT, case
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
    """The estimate of a case: is it warned of, far off, silently wrong?"""
    view = View(case.camera, case.points_2d, ids=case.ids, sigma=_WARNED_PX)
    result = cadalign.align(case.model, view, **case.options)
    poses = [result.alignment, *(each.alignment for each in result.alternatives)]
    off = [rotation_error(est=pose, gt=case.gt) > _LARGE_DEG for pose in poses]
    turn = section.deviation(est=result.alignment, gt=case.gt)[:3]
    level = probability_level(turn, result.covariance[:3, :3], result.degrees_of_freedom)
    is_warned = bool(result.warnings)
    beyond = level is not None and level > _REGION
    return {
        "warned": is_warned,
        "large": off[0],
        "silent": all(off) and beyond and not is_warned,
    }


def _shares(rows: list[Row], names: tuple[str, str], columns: Sequence[str]) -> Iterator[Row]:
    """Shares of the rows that agree in both names, and in the first one alone."""
    first, second = names
    for key in dict.fromkeys(row[first] for row in rows):
        of_first = [row for row in rows if row[first] == key]
        for label in (*dict.fromkeys(row[second] for row in of_first), "all"):
            chosen = [row for row in of_first if label in (row[second], "all")]
            shares = {name: percent([row[name] for row in chosen]) for name in columns}
            yield {first: key, second: label, "count": len(chosen)} | shares
