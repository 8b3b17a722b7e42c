"""Coverage of stated uncertainties, and warnings of large errors."""

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
from cadalign import Alignment, Camera, Model, RansacOptions, Result, View
from cadalign.arrays import FloatArray
from cadalign.estimation.warning import MISFIT_KINDS
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.metrics.cramer_rao import probability_level
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.metrics import rotation_error

_LARGE_ROTATION_DEG, _LARGE_SCALE = 15.0, 0.25
_COVERED = 0.95
_CALIBRATED_SIZES = (5, 6, 7, 8, 10, 20, 50, 100)
_KINDS = ("fit", "sigma=None", "20 % outliers", "focal", "shape_sigma=.05", "two views")
_REGION_SIZES = (5, 6, 8, 12, 30, 100, 200)
_SHAPE_SIGMA = 0.05
_STRETCH_SIGMA = 0.2
_SHAPE_SIGMAS = (0.01, 0.05, 0.1)
_SIMILAR_SIZES = (6, 12, 30, 60, 200)
_REGIONS = ("R", "t", "lengths")

Draw = Callable[[np.random.Generator], SimulatedProblem]


def coverage(
    given: BenchmarkData, *, problems: int = 1000, noise_px: float = 1.0, region_problems: int = 150
) -> Tables:
    """Coverage of stated uncertainties, and how often large errors come without a warning.

    Problems are the simulation's (f = 150 px). An error is large from 15 deg or 25 % of a scale,
    and silent without warning and alternative.

    Parameters
    ----------
    problems : int
        Random problems per row.
    noise_px : float
        Standard deviation of the noise [px], which sigma states.
    region_problems : int
        Random objects in a unit cube per row of the regions.
    """
    yield "Truths within nominal 68, 95 %", _regions(given.seed, noise_px, region_problems)
    yield "Similar models, more and more keypoints", _similar(given.seed, region_problems)
    yield "Errors within the 95 % ellipsoid", _coverage(given.seed, problems, noise_px)
    title = "Large errors without a warning, and misfits found"
    yield title, _warnings(given.seed, problems, noise_px)


def _regions(seed: int, noise_px: float, region_problems: int) -> Iterator[Row]:
    for kind in _KINDS:
        for points in _REGION_SIZES:
            draw = partial(_estimated, kind=kind, points=points, noise_px=noise_px)
            reached = [_levels(*each) for each in _estimates(draw, seed, points, region_problems)]
            row: Row = {"estimate": kind, "keypoints": points, "results": len(reached)}
            if reached:  # not all were refused
                row |= dict(zip(_REGIONS, map(_within, np.transpose(reached)), strict=True))
            yield row


def _similar(seed: int, region_problems: int) -> Iterator[Row]:
    for stretch in ("free", "none"):
        for shape_sigma in _SHAPE_SIGMAS:
            for points in _SIMILAR_SIZES:
                how = {"shape_sigma": shape_sigma, "stretch": stretch, "points": points}
                draw = partial(_similar_estimate, **how)
                found = _estimates(draw, seed, points, region_problems)
                bias, stated, turn, level = np.transpose(found)
                yield {
                    "stretch": stretch,
                    "shape_sigma": shape_sigma,
                    "keypoints": points,
                    "log distance": float(bias.mean()),
                    "stated": float(np.sqrt((stated**2).mean())),
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


def _coverage(seed: int, problems: int, noise_px: float) -> Iterator[Row]:
    for sigma, loss in ((noise_px, "linear"), (None, "linear"), (None, "cauchy")):
        for points in _CALIBRATED_SIZES[1:]:
            draw = partial(simulate_problem, points=points, noise_px=noise_px)
            held = []
            for problem, result in _fits(seed, draw, sigma=sigma, loss=loss, problems=problems):
                error = section.deviation(est=result.alignment, gt=problem.alignment)
                levels = (
                    probability_level(error, covariance)
                    for covariance in (result.fisher_covariance, result.covariance)
                )
                held.append([*(level < _COVERED for level in levels), not result.alternatives])
            names = ("inverse Fisher %", "stated %", "no alternative %")
            row = {"sigma": str(sigma), "loss": loss, "keypoints": points}
            yield row | dict(zip(names, map(section.percent, np.transpose(held)), strict=True))


def _warnings(seed: int, problems: int, noise_px: float) -> Iterator[Row]:
    for name, draw, options in _warned_cases(noise_px):
        fits = list(_fits(seed, draw, **options, problems=problems))
        large = [
            result for problem, result in fits if _is_large(result.alignment, problem.alignment)
        ]
        silent = sum(not result.warnings and not result.alternatives for result in large)
        misfits = sum(any(w.kind in MISFIT_KINDS for w in result.warnings) for _, result in fits)
        yield {
            "data": name,
            "fits": len(fits),
            "large errors": len(large),
            "silent": silent,
            "silent %": 100 * silent / max(len(large), 1),
            "misfits %": 100 * misfits / max(len(fits), 1),
        }


def _fits(
    seed: int, draw: Draw, *, problems: int, **options: Any
) -> Iterator[tuple[SimulatedProblem, Result]]:
    """Problems with their fits; those that are refused are left out."""
    for number in range(problems):
        problem = draw(np.random.default_rng([seed, number]))
        result = section.fitted(problem, **options)
        if result is not None:
            yield problem, result


def _placed(rng: np.random.Generator, scale: FloatArray) -> Alignment:
    """A random pose some units before the camera."""
    turn = Rotation.random(random_state=rng).as_matrix()
    return Alignment(turn, rng.uniform((-0.3, -0.2, 3.0), (0.3, 0.2, 5.0)), scale)


def _estimated(
    rng: np.random.Generator, *, kind: str, points: int, noise_px: float
) -> tuple[Result, Alignment]:
    model = rng.uniform(-0.5, 0.5, (points, 3))
    scale = np.array([1.0, *np.exp(rng.normal(0, _STRETCH_SIGMA, 2))])
    differs = _SHAPE_SIGMA if kind.startswith("shape_sigma") else 0.0
    object_points = model * scale + rng.normal(0, 1, model.shape) * differs
    camera, poses = KEYPOINT_CAMERA, [_placed(rng, np.ones(3)) for _ in range(2)]
    seen = [section.seen_in(camera, each, object_points, noise_px, rng).points_2d for each in poses]
    truth = replace(poses[0], scale=scale)
    if kind == "two views" or differs:
        views = [View(camera, each, sigma=noise_px) for each in seen]
        own = Model(points_3d=model, shape_sigma=differs) if differs else Model(points_3d=model)
        return cadalign.align(own, views[:1] if differs else views), truth
    options = dict[str, Any](sigma=noise_px)
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
    seen = section.seen_in(KEYPOINT_CAMERA, truth, moved, 1.0, rng).points_2d
    prior: dict[str, Any] = (
        {"stretch_sigma": _STRETCH_SIGMA} if stretch == "free" else {"stretch": "none"}
    )
    own = Model(points_3d=model, shape_sigma=shape_sigma, **prior)
    result = cadalign.align(own, View(KEYPOINT_CAMERA, seen, sigma=1.0))
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


def _warned_cases(noise_px: float) -> list[tuple[str, Draw, dict[str, Any]]]:
    """Names, problems and options of `fit`; first data with outliers, then inliers alone."""

    def draw(points: int, change: Callable[..., None] | None = None) -> Draw:
        def problem_of(rng: np.random.Generator) -> SimulatedProblem:
            problem = simulate_problem(rng, points=points, noise_px=noise_px)
            if change is not None:
                change(rng, problem.points_2d)
            return problem

        return problem_of

    def misplace(rng: np.random.Generator, points_2d: FloatArray) -> None:
        points_2d[rng.integers(len(points_2d))] = rng.uniform(0, (640, 480))

    def swap(rng: np.random.Generator, points_2d: FloatArray) -> None:
        pair = rng.choice(len(points_2d), 2, replace=False)
        points_2d[pair] = points_2d[pair[::-1]]

    given = {"sigma": noise_px}
    return [
        ("1 wrong of 8", draw(8, misplace), given),
        ("2 swapped of 12", draw(12, swap), given),
        ("20 shuffled", draw(20, np.random.Generator.shuffle), given),
        ("10, stretch none", draw(10), given | {"stretch": "none"}),
        ("1 wrong of 8, cauchy", draw(8, misplace), given | {"loss": "cauchy"}),
        *((f"{points} right", draw(points), given) for points in _CALIBRATED_SIZES),
        ("8 right, cauchy", draw(8), given | {"loss": "cauchy"}),
        ("8 right, prior", draw(8), given | {"stretch_sigma": 0.5}),
        ("8 right, covariances", draw(8), {"sigma": np.tile(noise_px**2 * np.eye(2), (8, 1, 1))}),
        ("8 right, focal unknown", draw(8), given | {"focal": "estimate"}),
        ("20 right, RANSAC", draw(20), given | {"ransac": RansacOptions(max_iterations=300)}),
    ]


def _is_large(est: Alignment, gt: Alignment) -> bool:
    is_turned = rotation_error(est=est, gt=gt) > _LARGE_ROTATION_DEG
    return is_turned or bool(np.abs(est.scale / gt.scale - 1).max() > _LARGE_SCALE)
