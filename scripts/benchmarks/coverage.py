"""Coverage of stated uncertainties, and warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, T, Tables
from benchmarks.warned import warned
from cadalign import Alignment, Camera, Model, RansacOptions, Result, View
from cadalign.arrays import FloatArray
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.metrics.errors import probability_level
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
    yield from warned(given)


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
    return ", ".join(f"{section.percent(levels <= share):.0f}" for share in (0.68, 0.95))


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
