"""Warnings on right data and on mistakes: false alarms, named mistakes, and silent ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables, percent
from cadalign import Alignment, Camera, Model, RansacOptions, ShapeModel, View, align
from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.metrics.errors import probability_level
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.metrics import rotation_error

_NOISE_PX = 2.0
_STRETCH_SIGMA, _SHAPE_SIGMA = 0.2, 0.02  # of logarithms; of keypoints [diagonals]
_LEAST_KEYPOINTS = 6
_MOVED_PX = 40.0
_LARGE_DEG, _REGION = 10.0, 0.999
_RIGHT = "none"


def warned(given: BenchmarkData) -> Tables:
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
        how = {"noise_px": _NOISE_PX, "max_models": count}
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
    moved = stretched + rng.normal(0, _SHAPE_SIGMA, points.shape)
    how: dict[str, Any] = {"shape_sigma": _SHAPE_SIGMA, "stretch_sigma": _STRETCH_SIGMA}
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
    view = View(case.camera, case.points_2d, ids=case.ids, sigma=_NOISE_PX)
    result = align(case.model, view, **case.options)
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
