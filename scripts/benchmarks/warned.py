"""Warnings on right data, which need none, and on wrong data, which they should name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables, percent
from cadalign import Alignment, Model, ShapeModel, View
from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.metrics.cramer_rao import probability_level
from cadalign.metrics import rotation_error

_PAIRS = 200  # of training models, which tell how models of a category differ
_LEAST_KEYPOINTS = 4
_STRETCH_SIGMA = 0.2
_LARGE_DEG, _REGION = 10.0, 0.99
_FARTHER = np.array([0.0, 0.0, 0.2])  # until a drawn object is in the image
_MOVED_PX = 40.0
_MIRRORED = 0.05  # distance of a keypoint from the other one's mirror image [diagonals]
_MISFIT = {"misfit", "outlier", "stretch", "camera", "contradiction", "mistake"}


_Differ = tuple[float, float]
"""How a category's models differ: standard deviations of keypoints and of log stretches."""


class _Case(NamedTuple):
    """A model, its noisy keypoints in a view by id, and the object's pose."""

    model: Model | ShapeModel
    ids: list[int]
    points_3d: FloatArray  # (n, 3) of the object
    points_2d: FloatArray  # (n, 2)
    gt: Alignment

    def of_model(self, model: Model | ShapeModel, ids: Sequence[Any]) -> _Case:
        """The keypoints that another model has, too."""
        shared = np.isin(self.ids, ids)
        kept = [name for name in self.ids if name in ids]
        return _Case(model, kept, self.points_3d[shared], self.points_2d[shared], self.gt)


def warned(given: BenchmarkData) -> Tables:
    """Warnings on right data, and how many of them are of large errors; on wrong data.

    Objects of KeypointNet's split val with all keypoints and 2 px of noise, up to 40 of each
    category. Right models are: the object's own one, stretched; one from which its keypoints are
    displaced at random, and a random other one, by as much as models of the category differ
    (`shape_sigma`, `stretch_sigma`); the shape that was learned from the split train. Whether
    warnings tell good estimates from bad ones is seen in rotations off by more than 10 deg or
    beyond the stated 99 % region, among those warned of and among the others.
    """
    how = {"objects": given.count or 40, "noise_px": 2.0, "categories": (), "wrong": True}
    rows = list(warned_cases(KeypointNet(given.needed()), **how))
    right = [row for row in rows if row["data"] == "right"]
    others = [row for row in rows if row["data"] != "right"]
    yield "Warned of on right data [%]", _by(right, ("model", "category"), _shares)
    yield "Wrong data named [%]", _by(others, ("data", "model"), _named)


def warned_cases(
    dataset: KeypointNet, *, objects: int, noise_px: float, categories: tuple[str, ...], wrong: bool
) -> Iterator[Row]:
    """Every case with its warnings and errors."""
    chosen = categories or tuple(dataset.categories)
    shapes = {name: section.learned_shape(dataset, name) for name in chosen}
    for number, category in enumerate(chosen):
        differ = models_differ(dataset, category)
        foreign = shapes[chosen[number - 1]]
        options = {"noise_px": noise_px, "max_models": objects}
        for place, seen in section.unseen_objects(dataset, category, objects, **options):
            rng = instance_rng(0, category, str(place), "warned")
            for name, case in _right(dataset, seen, shapes[category], differ, rng, noise_px):
                labels = {"category": category, "model": name}
                yield labels | {"data": "right"} | _outcome(case, noise_px)
                for how, bad in list(_wrong(case, foreign, rng)) * wrong:
                    yield labels | {"data": how} | _outcome(bad, noise_px)


def _right(
    dataset: KeypointNet,
    seen: UnseenObject,
    shape: ShapeModel,
    differ: _Differ,
    rng: np.random.Generator,
    noise_px: float,
) -> Iterator[tuple[str, _Case]]:
    points, ids = seen.xyz[seen.rows], seen.ids.tolist()
    if len(points) < _LEAST_KEYPOINTS:
        return
    stretch = np.exp(np.append(0.0, rng.normal(0, _STRETCH_SIGMA, 2)))
    model = Model(points_3d=points / stretch, ids=ids)
    own = _Case(model, ids, points, seen.points_2d, seen.gt)
    yield "own", own
    by_shape, by_stretch = differ
    how: dict[str, Any] = {"shape_sigma": by_shape, "stretch_sigma": by_stretch}
    stretch = np.exp(np.append(0.0, rng.normal(0, by_stretch, 2)))
    object_points = (points + rng.normal(0, by_shape, points.shape)) * stretch
    gt, noise = seen.gt, rng.normal(0, noise_px, seen.points_2d.shape)
    camera = KEYPOINT_CAMERA
    while not camera.contains(pixels := camera.project(gt.apply(object_points)) + noise).all():
        gt = replace(gt, translation=gt.translation + _FARTHER)
    drawn = Model(points_3d=points, ids=ids, **how)
    yield "similar, drawn", _Case(drawn, ids, object_points, pixels, gt)
    others = _training_models(dataset, seen.task.category)
    for number in rng.permutation(len(others)).tolist():
        of_other, xyz = others[number]
        if np.isin(ids, of_other).sum() >= min(6, len(ids)):
            other = Model(points_3d=xyz, ids=of_other, **how)
            yield "similar, other", own.of_model(other, of_other)
            break
    yield "learned", own.of_model(shape, shape.ids)


# Data ---------------------------------------------------------------------------------------------


def _training_models(dataset: KeypointNet, category: str) -> list[tuple[list[int], FloatArray]]:
    models = dataset.subset(split="train")[category]
    return [(each.keypoints.ids.tolist(), each.keypoints.xyz) for each in models]


def models_differ(dataset: KeypointNet, category: str) -> _Differ:
    """Differences of models of the split train, shifted and stretched onto each other.

    Axes along which the models are flat have no stretch.
    """
    models = _training_models(dataset, category)
    rng = instance_rng(0, category, "differ")
    squares, equations, logs = 0.0, 0, []
    for _ in range(_PAIRS):
        (ids, points), (other_ids, other) = (models[k] for k in rng.choice(len(models), 2, False))
        shared = sorted(set(ids) & set(other_ids))
        if len(shared) < _LEAST_KEYPOINTS:
            continue
        a = other[[other_ids.index(name) for name in shared]]
        b = points[[ids.index(name) for name in shared]]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        stretch = np.sqrt((b * b).sum(axis=0) / np.maximum((a * a).sum(axis=0), 1e-12))
        thick = np.minimum(a.std(axis=0), b.std(axis=0)) > 0.02
        if thick[0]:
            logs += [np.log(stretch[k] / stretch[0]) for k in (1, 2) if thick[k]]
        rest = b / np.where(thick, stretch, 1.0) - a
        squares += float((rest**2).sum())
        equations += rest.size - 3 - int(thick.sum())
    return float(np.sqrt(squares / equations)), float(np.std(logs)) if logs else 0.2


def _wrong(
    case: _Case, foreign: ShapeModel, rng: np.random.Generator
) -> Iterator[tuple[str, _Case]]:
    """The case with a keypoint moved, two of them swapped, or another category's model."""
    row, angle = int(rng.integers(len(case.ids))), rng.uniform(0, 2 * np.pi)
    moved = case.points_2d.copy()
    moved[row] += _MOVED_PX * np.array([np.cos(angle), np.sin(angle)])
    if KEYPOINT_CAMERA.contains(moved).all():
        yield "moved by 40 px", case._replace(points_2d=moved)
    mirrored = case.points_3d * [-1, 1, 1]
    pairs = [
        (i, j)
        for i, j in combinations(range(len(case.ids)), 2)
        if np.linalg.norm(mirrored[i] - case.points_3d[j]) < _MIRRORED
        and np.linalg.norm(case.points_2d[i] - case.points_2d[j]) > _MOVED_PX
    ]
    if pairs:
        i, j = pairs[int(rng.integers(len(pairs)))]
        swapped = case.points_2d.copy()
        swapped[[i, j]] = swapped[[j, i]]
        yield "left and right swapped", case._replace(points_2d=swapped)
    count = min(len(case.ids), len(foreign.ids))
    ids, model = list(foreign.ids[:count]), foreign
    if isinstance(case.model, Model):
        how = {"shape_sigma": case.model.shape_sigma, "stretch_sigma": case.model.stretch_sigma}
        model = Model(points_3d=foreign.mean[:count], ids=ids, **how)
    seen = case.points_3d[:count], case.points_2d[:count]
    yield "another category", _Case(model, ids, *seen, case.gt)


# Outcomes -----------------------------------------------------------------------------------------


def _outcome(case: _Case, noise_px: float) -> Row:
    """Refusal of the case, or kinds of its warnings and whether the rotation is far off."""
    view = View(KEYPOINT_CAMERA, case.points_2d, ids=case.ids, sigma=noise_px)
    result = section.attempt(cadalign.align, case.model, view)
    if result is None:
        return {"refused": True}
    kinds = {warning.kind for warning in result.warnings}
    turn = section.deviation(est=result.alignment, gt=case.gt)[:3]
    level = probability_level(turn, result.covariance[:3, :3], result.degrees_of_freedom)
    return {
        "refused": False,
        "warned": bool(kinds),
        "misfit": bool(kinds & _MISFIT),
        "large": rotation_error(est=result.alignment, gt=case.gt) > _LARGE_DEG,
        "beyond": level is not None and level > _REGION,
    }


def _by(rows: list[Row], names: tuple[str, str], columns: Callable[[list[Row]], Row]) -> list[Row]:
    """Rows of a table: columns by both of two names, and by the first alone; none of refusals."""
    first, second = names
    rows, found = [row for row in rows if not row["refused"]], []
    for key in dict.fromkeys(row[first] for row in rows):
        chosen = [row for row in rows if row[first] == key]
        for label in dict.fromkeys(row[second] for row in chosen):
            of_both = [row for row in chosen if row[second] == label]
            found.append({first: key, second: label} | columns(of_both))
        found.append({first: key, second: "all"} | columns(chosen))
    return found


def _shares(rows: list[Row]) -> Row:
    warned, others = ([row for row in rows if row["warned"] == way] for way in (True, False))
    return {
        "count": len(rows),
        "warned": percent([row["warned"] for row in rows]),
        "> 10 deg, warned": _share(warned, "large"),
        "> 10 deg, others": _share(others, "large"),
        "beyond 99 %, warned": _share(warned, "beyond"),
        "beyond 99 %, others": _share(others, "beyond"),
    }


def _share(rows: list[Row], name: str) -> float | None:
    return percent([row[name] for row in rows]) if rows else None


def _named(rows: list[Row]) -> Row:
    return {"count": len(rows), "named": percent([row["misfit"] for row in rows])}
