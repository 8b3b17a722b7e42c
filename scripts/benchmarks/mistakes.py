"""Mistakes, and right data: what estimates say of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables, percent, seen_in
from cadalign import (
    Alignment,
    CadalignError,
    Model,
    RansacOptions,
    Result,
    ShapeModel,
    View,
    align,
    fit,
)
from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.metrics.cramer_rao import probability_level
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import angle_between
from cadalign.metrics import rotation_error
from cadalign.render import look_at
from cadalign.solvers.constants import UNKNOWNS

_CATEGORIES = ("chair", "bottle", "airplane", "mug", "bathtub", "guitar")
_SIMILAR = ("chair", "bottle", "mug")
_SHAPE_SIGMA = 0.02  # of similar models [diagonals]
_NOISE_PX, _OUTLIERS = 1.0, 0.3
_FEWEST, _MOST = 7, 16  # keypoints
_STRETCH_SIGMA = 0.25  # of log scales
_DISTANCE, _ELEVATION_DEG = (2.0, 4.0), (-10.0, 50.0)
_WRONG_DEG = 10.0
_CLAUSES = ("is mirrored", "are swapped", "is flipped", "from the bottom")
_SIZE = KEYPOINT_CAMERA.width, KEYPOINT_CAMERA.height
_WARNED_NOISE_PX = 2.0
_PAIRS = 200  # of training models, which tell how models of a category differ
_LEAST_SHARED = 4
_WARNED_STRETCH_SIGMA = 0.2
_LARGE_DEG, _REGION = 10.0, 0.99
_FARTHER = np.array([0.0, 0.0, 0.2])  # until a drawn object is in the image
_MOVED_PX = 40.0
_MIRRORED = 0.05  # distance of a keypoint from the other one's mirror image [diagonals]
_MISFIT = {"misfit", "outlier", "stretch", "camera", "contradiction", "mistake"}


def mistakes(given: BenchmarkData) -> Tables:
    """Mistakes that robust estimates name, and warnings on right and on wrong data."""
    yield from _mistakes(given)
    yield from _warned(given)


def _mistakes(given: BenchmarkData) -> Tables:
    """Shares of mistakes that stay unnoticed, and of right keypoints that raise an alarm [%].

    Keypoints of KeypointNet's models, stretched, with 1 px of noise. Unnoticed is an estimate
    without a warning but for uncertainties, and with a rotation that is more than 10 degrees off.
    """
    dataset, models = KeypointNet(given.folder("keypointnet")), {}
    for category in _CATEGORIES:
        points = (each.keypoints.xyz for each in dataset[category])
        models[category] = [each for each in points if len(each) >= _FEWEST]
    for title, names, count, sigma in (
        ("mistakes [%]", _CATEGORIES, given.count or 300, 0.0),
        ("of similar models [%]", _SIMILAR, given.count or 100, _SHAPE_SIGMA),
    ):
        rows = [
            {"category": name} | _shares(models[name], given.seed, count, sigma) for name in names
        ]
        yield title, rows


class SeenModel(NamedTuple):
    """Keypoints of a stretched, upright object in a photo, and its rotation."""

    points_3d: FloatArray
    points_2d: FloatArray
    rotation: FloatArray

    def changed(self) -> dict[str, SeenModel]:
        """The same with the model mirrored, u from the other side, and u and v swapped."""
        last = KEYPOINT_CAMERA.width - 2 * PIXEL_CENTRE
        return {
            "mirrored": self._replace(points_3d=self.points_3d * [-1, 1, 1]),
            "flipped": self._replace(points_2d=self.points_2d * [-1, 1] + [last, 0]),
            "swapped": self._replace(points_2d=self.points_2d[:, ::-1].copy()),
        }

    def with_outliers(self, rng: np.random.Generator) -> SeenModel:
        """The same, some keypoints anywhere in the image."""
        count = len(self.points_2d)
        wrong = rng.choice(count, round(_OUTLIERS * count), replace=False)
        pixels = self.points_2d.copy()
        pixels[wrong] = rng.uniform(0, _SIZE, (len(wrong), 2))
        return self._replace(points_2d=pixels)


def _shares(models: list[FloatArray], seed: int, problems: int, shape_sigma: float) -> Row:
    said: dict[str, list[tuple[bool, bool, bool, bool]]] = {}
    for number in range(problems):
        rng = np.random.default_rng([seed, number])
        seen, few = _seen(models, rng), _seen(models, rng, _FEWEST)
        moved = rng.normal(0, shape_sigma, seen.points_3d.shape)
        seen = seen._replace(points_3d=seen.points_3d + moved)
        given = seen.changed() | {"right": seen, "outliers": seen.with_outliers(rng)}
        if not shape_sigma:
            given["7 keypoints"] = few.with_outliers(rng)
        for kind, each in given.items():
            said.setdefault(kind, []).append(_said(each, shape_sigma))
    row: Row = {}
    unnoticed = explained = 0
    for kind, found in said.items():
        silent, named, refused, fits = np.transpose(found)
        if kind in ("mirrored", "flipped", "swapped"):
            row[f"{kind} unnoticed"] = percent(silent)
            unnoticed, explained = unnoticed + silent.sum(), explained + (silent & fits).sum()
        else:
            row[f"{kind} named"], row[f"{kind} refused"] = percent(named), percent(refused)
    return row | {"of the unnoticed, all keypoints fit": f"{explained} of {unnoticed}"}


def _seen(
    models: list[FloatArray], rng: np.random.Generator, count: int | None = None
) -> SeenModel:
    points = models[rng.integers(len(models))]
    size = count or int(rng.integers(_FEWEST, min(len(points), _MOST) + 1))
    points = points[rng.choice(len(points), size, replace=False)]
    azimuth, elevation = rng.uniform(0, 360), rng.uniform(*_ELEVATION_DEG)
    stretched = points * np.exp([0.0, *rng.normal(0, _STRETCH_SIGMA, 2)])
    pose = look_at(azimuth=azimuth, elevation=elevation, distance=rng.uniform(*_DISTANCE))
    seen = seen_in(KEYPOINT_CAMERA, pose, stretched, _NOISE_PX, rng)
    return SeenModel(points, seen.points_2d, pose.rotation)


def _said(seen: SeenModel, shape_sigma: float) -> tuple[bool, bool, bool, bool]:
    """True for a wrong rotation without a word, for a mistake that is named, and for a refusal.

    Last, if all keypoints fit the estimate within their noise, at 1 %: nothing contradicts it.
    """
    try:
        found = _estimate(seen, shape_sigma)
    except CadalignError as error:
        return False, any(each in str(error) for each in _CLAUSES), True, False
    kinds = {warning.kind for warning in found.warnings} - {"focal"}
    turn = angle_between(found.alignment.rotation, seen.rotation)
    square, count = (found.residuals**2).sum() / _NOISE_PX**2, found.residuals.size
    fits = found.inliers.all() and square < chi2.isf(0.01, max(count - UNKNOWNS, 1))
    return not kinds and turn > _WRONG_DEG, "mistake" in kinds, False, bool(fits)


def _estimate(seen: SeenModel, shape_sigma: float) -> Result:
    if not shape_sigma:
        return fit(seen.points_3d, seen.points_2d, KEYPOINT_CAMERA, ransac=RansacOptions())
    model = Model(points_3d=seen.points_3d, shape_sigma=shape_sigma)
    return align(model, View(KEYPOINT_CAMERA, seen.points_2d), ransac=RansacOptions())


# Warnings -----------------------------------------------------------------------------------------

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


def _warned(given: BenchmarkData) -> Tables:
    """Warnings on right data, and how many of them are of large errors; on wrong data.

    Objects of KeypointNet's split val with all keypoints and 2 px of noise, up to 40 of each
    category. Right models are: the object's own one, stretched; one from which its keypoints are
    displaced at random, and a random other one, by as much as models of the category differ
    (`shape_sigma`, `stretch_sigma`); the shape that was learned from the split train. Whether
    warnings tell good estimates from bad ones is seen in rotations off by more than 10 deg or
    beyond the stated 99 % region, among those warned of and among the others.
    """
    rows = list(_warned_cases(KeypointNet(given.folder("keypointnet")), given.count or 40))
    right = [row for row in rows if row["data"] == "right"]
    others = [row for row in rows if row["data"] != "right"]
    yield "Warned of on right data [%]", _by(right, ("model", "category"), _warned_shares)
    yield "Wrong data named [%]", _by(others, ("data", "model"), _named)


def _warned_cases(dataset: KeypointNet, objects: int) -> Iterator[Row]:
    """Every case with its warnings and errors."""
    categories = list(dataset.categories)
    for number, category in enumerate(categories):
        shape, differ = section.learned_shape(dataset, category), _models_differ(dataset, category)
        foreign = section.learned_shape(dataset, categories[number - 1])
        options = {"noise_px": _WARNED_NOISE_PX, "max_models": objects}
        for place, seen in section.unseen_objects(dataset, category, objects, **options):
            rng = instance_rng(0, category, str(place), "warned")
            for name, case in _right(dataset, seen, shape, differ, rng):
                labels = {"category": category, "model": name}
                yield labels | {"data": "right"} | _outcome(case)
                for how, bad in list(_wrong(case, foreign, rng)):
                    yield labels | {"data": how} | _outcome(bad)


def _right(
    dataset: KeypointNet,
    seen: UnseenObject,
    shape: ShapeModel,
    differ: _Differ,
    rng: np.random.Generator,
) -> Iterator[tuple[str, _Case]]:
    points, ids = seen.xyz[seen.rows], seen.ids.tolist()
    if len(points) < _LEAST_SHARED:
        return
    stretch = np.exp(np.append(0.0, rng.normal(0, _WARNED_STRETCH_SIGMA, 2)))
    model = Model(points_3d=points / stretch, ids=ids)
    own = _Case(model, ids, points, seen.points_2d, seen.gt)
    yield "own", own
    by_shape, by_stretch = differ
    how: dict[str, Any] = {"shape_sigma": by_shape, "stretch_sigma": by_stretch}
    stretch = np.exp(np.append(0.0, rng.normal(0, by_stretch, 2)))
    object_points = (points + rng.normal(0, by_shape, points.shape)) * stretch
    gt, noise = seen.gt, rng.normal(0, _WARNED_NOISE_PX, seen.points_2d.shape)
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


def _training_models(dataset: KeypointNet, category: str) -> list[tuple[list[int], FloatArray]]:
    models = dataset.subset(split="train")[category]
    return [(each.keypoints.ids.tolist(), each.keypoints.xyz) for each in models]


def _models_differ(dataset: KeypointNet, category: str) -> _Differ:
    """Differences of models of the split train, shifted and stretched onto each other.

    Axes along which the models are flat have no stretch.
    """
    models = _training_models(dataset, category)
    rng = instance_rng(0, category, "differ")
    squares, equations, logs = 0.0, 0, []
    for _ in range(_PAIRS):
        (ids, points), (other_ids, other) = (models[k] for k in rng.choice(len(models), 2, False))
        shared = sorted(set(ids) & set(other_ids))
        if len(shared) < _LEAST_SHARED:
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


def _outcome(case: _Case) -> Row:
    """Refusal of the case, or kinds of its warnings and whether the rotation is far off."""
    view = View(KEYPOINT_CAMERA, case.points_2d, ids=case.ids, sigma=_WARNED_NOISE_PX)
    result = section.attempt(align, case.model, view)
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


def _warned_shares(rows: list[Row]) -> Row:
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
