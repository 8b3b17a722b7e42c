"""Masks beside keypoints and alone: exact ones, damaged ones."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.stats import chi2

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Camera, Model, View, align
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets import AnnotatedModel
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.metrics import nearest_truth, rotation_error
from cadalign.render import Scene, cast_geometry, sample_view

_STRETCH = 2.0
_LEAST_KEYPOINTS = 4
_RIGHT_DEG, _RIGHT_STRETCH = 10.0, 0.15
_FAR_OFF = 0.1  # of the logarithms of stretch and distance
_FILLS = ((0.75, 0.95), (0.5, 0.75), (0.25, 0.5), (0.12, 0.25))  # of the image, by the object
_FREE = [0, 1, 2, 3, 4, 5, 7, 8]  # of a covariance, where x is known
_WANDER = 2.0  # [px], standard deviation of a smoothed contour
_WANDER_LENGTH = 5.0  # [px], over which it wanders
_HIDDEN = 0.25  # share of the area

_Meshed = tuple[AnnotatedModel, Scene]


def mask_optima(given: BenchmarkData) -> Tables:
    """Estimates by exact masks of models seen from anywhere, and whether they are as stated.

    Stretched by 0.5 to 2, with 1 px of noise of the keypoints, at four distances. The models are
    those of the sample dataset, and KeypointNet's with ShapeNet's meshes.
    """
    models = _models_of(given)
    rows = [_optima(models, fill, given.count or 130, given.seed) for fill in _FILLS]
    yield "exact masks, seen from anywhere", rows


def mask_alone(given: BenchmarkData) -> Tables:
    """The own model, of unknown stretch, from a mask without keypoints.

    Right is an estimate within 10 degrees and 15 % of stretch, up to the model's symmetry; of a
    model that is round about an axis, up to its size as well.
    """
    cases = []
    for number, model in enumerate(_models_of(given)):
        rng = np.random.default_rng([given.seed, number])
        drawn = [_drawn(model, rng, fill=(0.6, 0.9), roll=10.0) for _ in range(given.count or 3)]
        cases += [case for case in drawn if case]
    kinds = ("exact", "dilated", "smoothed", "hidden", "border")
    yield f"a mask alone, {len(cases)} views", [_alone(cases, kind, given.seed) for kind in kinds]


@dataclass(frozen=True)
class _Case:
    """A view of a model: true alignment, keypoints with noise, and the exact mask."""

    annotated: AnnotatedModel
    scene: Scene
    ids: list[int]
    seen: SimulatedProblem
    mask: BoolArray

    def is_right(self, est: Alignment) -> bool:
        """True for an estimate near the truth, or near one that is equal to it."""
        symmetry = self.annotated.symmetry
        gt = nearest_truth(est=est, gt=self.seen.alignment, symmetry=symmetry)
        logs = np.log(est.scale / gt.scale)
        if symmetry.axes:
            logs -= logs.mean()
        is_turned = rotation_error(est=est, gt=gt) >= _RIGHT_DEG
        return not is_turned and bool(np.abs(logs).max() < _RIGHT_STRETCH)


def _models_of(given: BenchmarkData) -> list[_Meshed]:
    with tempfile.TemporaryDirectory() as folder:
        sample, real = section.meshed_models(given, folder, per_category=1)
        return [(model, Scene(model.load_mesh())) for model in (*sample, *real)]


def _drawn(model: _Meshed, rng: np.random.Generator, **how: Any) -> _Case | None:
    """A view of a stretched model that shows enough keypoints, if there is one."""
    annotated, scene = model
    scale = np.array([1.0, *np.exp(rng.uniform(-1, 1, 2) * np.log(_STRETCH))])
    seen = scene, annotated.keypoints.xyz, KEYPOINT_CAMERA
    how |= {"rng": rng, "scale": scale}
    view = section.attempt(sample_view, *seen, min_visible=7, **how)
    view = view or section.attempt(sample_view, *seen, min_visible=_LEAST_KEYPOINTS, **how)
    if view is None:
        return None
    ids = np.flatnonzero(view.visible).tolist()
    return _case_of(model, KEYPOINT_CAMERA, view.cam_from_model, ids, rng)


def _case_of(
    model: _Meshed, camera: Camera, truth: Alignment, ids: list[int], rng: np.random.Generator
) -> _Case:
    annotated, scene = model
    seen = section.seen_in(camera, truth, annotated.keypoints.xyz[ids], 1.0, rng)
    return _Case(annotated, scene, ids, seen, cast_geometry(scene, camera, truth).mask)


# Beside keypoints ---------------------------------------------------------------------------------


def _optima(models: list[_Meshed], fill: tuple[float, float], count: int, seed: int) -> Row:
    """Errors of objects at one distance, and whether these are stated."""
    found = []
    for number in range(count):
        rng = np.random.default_rng([seed, 3, round(100 * fill[0]), number])
        how = {"fill": fill, "roll": 180.0, "elevation": (-89.0, 89.0)}
        case = _drawn(models[number % len(models)], rng, **how)
        if case is None:
            continue
        model = Model(points_3d=case.annotated.keypoints.xyz, mesh=case.scene.mesh)
        seen = case.seen
        view = View(seen.camera, seen.points_2d, ids=case.ids, sigma=1.0, mask=case.mask)
        result = align(model, view)
        est, truth = result.alignment, seen.alignment
        # With the logarithm of the distance: it rises with the stretches where the size is open.
        error = section.deviation(est=truth, gt=est)[_FREE]
        error[3:6] = _shift_to(est.translation, truth.translation)
        square = error @ np.linalg.solve(result.covariance[np.ix_(_FREE, _FREE)], error)
        lengths = np.linalg.norm([truth.translation, est.translation], axis=1)
        stretch, distance = np.abs(error[6:]).max(), abs(np.log(lengths[1] / lengths[0]))
        found.append((stretch, distance, square))
    stretch, distance, squares = np.transpose(found)
    return {
        "image filled": f"{fill[0]:g} to {fill[1]:g}",
        "count": len(found),
        "beyond 10 %": int((np.maximum(stretch, distance) > _FAR_OFF).sum()),
        "beyond the 99.9 % region, %": section.percent(squares > chi2.ppf(0.999, len(_FREE))),
        "95 % regions hold": float((squares < chi2.ppf(0.95, len(_FREE))).mean()),
        "stretch, %": 100 * float(np.median(stretch)),
        "distance, %": 100 * float(np.median(distance)),
    }


def _shift_to(place: FloatArray, other: FloatArray) -> FloatArray:
    """The step to another place, of which the part along the direction is that of a logarithm."""
    square, along = float(place @ place), float(place @ other)
    ratio = np.log(np.linalg.norm(other) / np.sqrt(square))
    return np.asarray(ratio * place + square / along * other - place)


# Alone --------------------------------------------------------------------------------------------


def _alone(cases: list[_Case], kind: str, seed: int) -> Row:
    found = []
    for case, mask in _damaged(cases, kind, seed):
        model = Model(mesh=case.scene.mesh, symmetry=case.annotated.symmetry)
        view = View(case.seen.camera, mask=mask)
        wall, _, result = section.clocked(partial(section.attempt, align, model, view))
        poses = () if result is None else (result, *result.alternatives[:4])
        right = [case.is_right(pose.alignment) for pose in poses]
        found.append({"first": right[:1] == [True], "among five": any(right), "seconds": wall})
    return {"mask": kind, **section.summary(found)}


def _damaged(cases: list[_Case], kind: str, seed: int) -> Iterator[tuple[_Case, BoolArray]]:
    """The cases with their masks of one kind; moved, where the border cuts them."""
    for number, case in enumerate(cases):
        rng = np.random.default_rng([seed, 1, number])
        if kind == "border":
            cut = _cut_by_border(case, rng)
            yield cut, cut.mask
        else:
            yield case, damaged_mask(case.mask, kind, rng)


def _cut_by_border(case: _Case, rng: np.random.Generator) -> _Case:
    """The view with a quarter of the object outside the image; enough keypoints stay inside."""
    columns = np.cumsum(case.mask.sum(axis=0)) / case.mask.sum()
    shift = float(np.searchsorted(columns, 0.25))
    camera = replace(case.seen.camera, cx=case.seen.camera.cx - shift)
    model = case.annotated, case.scene
    return _case_of(model, camera, case.seen.alignment, case.ids, rng)


# Damages ------------------------------------------------------------------------------------------


def damaged_mask(mask: BoolArray, kind: str, rng: np.random.Generator) -> BoolArray:
    """A mask (h, w) with a damage.

    It is exact, dilated by 2 px, smoothed (its contour wanders by 2 px), or a quarter is hidden.
    """
    pixels = mask.astype(np.uint8)
    if kind == "dilated":
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
        return np.asarray(cv2.dilate(pixels, disc) > 0)
    if kind == "smoothed":
        inside = cv2.distanceTransform(pixels, cv2.DIST_L2, 5)
        outside = cv2.distanceTransform(1 - pixels, cv2.DIST_L2, 5)
        field = cv2.GaussianBlur(rng.normal(size=pixels.shape), (0, 0), _WANDER_LENGTH)
        return np.asarray(inside - outside + field * (_WANDER / field.std()) > 0)
    if kind == "hidden":
        turns = int(rng.integers(4))
        rest = np.rot90(pixels, turns).copy()
        shares = np.cumsum(rest.sum(axis=1)) / rest.sum()
        rest[: int(np.searchsorted(shares, _HIDDEN)) + 1] = 0
        return np.rot90(rest, -turns) > 0
    return pixels > 0
