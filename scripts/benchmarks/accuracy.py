"""Accuracy of the solvers against the Cramer-Rao bound, and their speed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Table, Tables
from cadalign import Alignment, Camera, RansacOptions
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.estimation.options import BOUNDING_PRIOR
from cadalign.estimation.problems import whitening_of
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, STRETCH_RANGE
from cadalign.evaluation.metrics.cramer_rao import cramer_rao_bound, sample_limit
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.simulation import (
    SIMULATION_CAMERA,
    SimulatedProblem,
    random_rotation,
    simulate_problem,
)
from cadalign.geometry.camera import faced, turned_alignment
from cadalign.solvers.alignment import evaluate_cost, keypoint_objective
from cadalign.solvers.linear import aepnp
from cadalign.solvers.minimal import ap4p
from cadalign.solvers.search import refine

_ROWS = ((6, 1.0), (7, 1.0), (10, 1.0), (20, 1.0), (100, 2.0), (1024, 2.0), (1024, 10.0))
_SPEED_SIZES = (10, 100, 1024, 4096)
_BATCH = 10_000
_METHODS = ("optimal", "aepnp", "aepnp-paper")
_ERRORS = {
    "rotation_error_deg": "R",
    "translation_error": "t",
    "scale_y_error": "s_y",
    "scale_z_error": "s_z",
}
_FAILED = {**dict.fromkeys(_ERRORS, np.inf), "rotation_error_deg": 180.0}
_FOCAL_ERRORS = {**_ERRORS, "focal_error": "f"}
_UNKNOWN = Camera.without_focal(SIMULATION_CAMERA.width, SIMULATION_CAMERA.height)
_ROBUST_POINTS = 100
_FIELDS = (120, 180, 200)  # of view [degrees]
_WIDE_SIDE = 1000  # of their images [px]

Draw = Callable[[np.random.Generator], SimulatedProblem]


# Known focal length -------------------------------------------------------------------------------


def solvers(given: BenchmarkData, *, problems: int = 2000, repetitions: int = 300) -> Tables:
    """Accuracy against the Cramer-Rao bound, speed against OpenCV.

    Everything runs in one process on the same problems; speeds are ratios of medians. KeypointNet
    adds rows on real keypoints.

    Parameters
    ----------
    problems : int
        Random problems per row.
    repetitions : int
        Timed calls per figure; the median counts.
    """
    sources: list[tuple[str, float, Draw]] = [
        (f"{n} points, {px:g} px", px, partial(simulate_problem, points=n, noise_px=px))
        for n, px in _ROWS
    ]
    if given.keypointnet is not None:
        sources += _keypointnet_sources(given.keypointnet)
    yield _accuracy_table(sources, problems, given.seed)
    title = "4 points: the truth among the minimal solver's solutions"
    yield title, [_minimal(given.seed, problems)]
    rng = np.random.default_rng(given.seed)
    rows = []
    for points in _SPEED_SIZES:
        problem = simulate_problem(rng, points=points, noise_px=1.0)
        rows += _speed(problem, points, repetitions)
    yield "Time over OpenCV's, which does not stretch", rows


def _minimal(seed: int, problems: int) -> Row:
    rng = np.random.default_rng(seed)
    found = solutions = 0
    for _ in range(problems):
        problem = simulate_problem(rng, points=4, noise_px=0.0)
        rays = problem.camera.normalize(problem.points_2d)
        rotations, translations, scales = ap4p(problem.points_3d, rays)
        poses = np.concatenate([rotations.reshape(-1, 9), translations, scales], axis=1)
        solutions += len(poses)
        found += bool((np.abs(poses - problem.alignment.packed) < 1e-4).all(axis=1).any())
    share, mean = 100 * found / problems, solutions / problems
    return {"truth found %": share, "solutions on average": mean}


def wide_lenses(given: BenchmarkData, *, problems: int = 1000, points: int = 20) -> Tables:
    """Accuracy of fits with wide lenses against the Cramer-Rao bound.

    Objects lie anywhere in the field of view, which fills an image of 1000 x 1000 px.

    Parameters
    ----------
    problems : int
        Random problems per row.
    points : int
        Keypoints of an object.
    """
    half, omega = (_WIDE_SIDE - 1) / 2, 0.9
    sources: list[tuple[str, float, Draw]] = []
    for field in _FIELDS:
        reach = np.radians(field / 2)
        bend = np.arctan2(2 * np.tan(omega / 2) * np.sin(reach), np.cos(reach)) / omega
        for lens, slope, coefficients in (("fisheye", reach, ()), ("fov", bend, (omega,))):
            size, focal = (_WIDE_SIDE, _WIDE_SIDE), half / slope
            camera = Camera(*size, focal, focal, half, half, coefficients, lens=lens)
            draw = partial(_wide_problem, camera, reach, points)
            sources.append((f"{lens}, {field} degrees", 1.0, draw))
    yield _accuracy_table(sources, problems, given.seed)


def _accuracy_table(sources: Iterable[tuple[str, float, Draw]], count: int, seed: int) -> Table:
    """Errors of every method over the limit's, and the global minima that it missed."""
    rows = []
    for name, noise, draw in sources:
        rng = np.random.default_rng(seed)
        problems = [draw(rng) for _ in range(count)]
        limit = _levels(_ideal_errors(problems, rng, sigma=noise, focal="known"))
        for method in _METHODS:
            is_best = method == "optimal"
            errors, failed, missed = [], 0, 0
            for problem in problems:
                result = section.fitted(problem, method=method, sigma=noise if is_best else 1.0)
                if result is None:
                    failed += 1
                    errors.append(_FAILED)
                    continue
                errors.append(alignment_errors(est=result.alignment, gt=problem.alignment))
                missed += is_best and _is_missed(problem, noise, result.alignment)
            found = _levels({key: [each[key] for each in errors] for key in _ERRORS})
            ratios = {s: tuple((found[k] / limit[k]).tolist()) for k, s in _ERRORS.items()}
            rows.append(
                {
                    "problems": name,
                    "limit R deg": tuple(limit["rotation_error_deg"].tolist()),
                    "method": method,
                    "median R deg": float(found["rotation_error_deg"][0]),
                    **ratios,
                    "failed %": 100 * failed / count,
                    "missed %": 100 * missed / count if is_best else None,
                }
            )
    return "Errors over the Cramer-Rao limit's: median (90th percentile)", rows


def _levels(errors: dict[str, Any]) -> dict[str, FloatArray]:
    return {name: np.percentile(values, (50, 90)) for name, values in errors.items()}


def _ideal_errors(
    problems: Iterable[SimulatedProblem], rng: np.random.Generator, *, sigma: float, focal: str
) -> dict[str, FloatArray]:
    """Errors of an ideal estimator on all problems, by name; see `cramer_rao_bound`."""
    draws = []
    for each in problems:
        given = each.points_3d, each.camera, each.alignment
        bound = section.attempt(cramer_rao_bound, *given, sigma=sigma, focal=focal)
        if bound is not None:
            draws.append(sample_limit(bound, rng=rng, draws=section.LIMIT_DRAWS))
    return {error: np.concatenate([draw[error] for draw in draws]) for error in draws[0]}


def _wide_problem(
    camera: Camera, reach: float, points: int, rng: np.random.Generator
) -> SimulatedProblem:
    """A problem as `simulate_problem` draws them, turned to anywhere in a field of view."""
    while True:
        drawn = simulate_problem(rng, points=points, noise_px=0.0, depth=(3.0, 6.0))
        pose = turned_alignment(drawn.alignment, random_rotation(rng))
        x, y, z = pose.apply(drawn.points_3d).T
        if (np.arctan2(np.hypot(x, y), z) < reach).all():
            return section.seen_in(camera, pose, drawn.points_3d, 1.0, rng)


def _keypointnet_sources(root: Path) -> Iterator[tuple[str, float, Draw]]:
    dataset = KeypointNet(root)
    for category in ("chair", "bottle", "airplane"):
        if category in dataset.categories:
            models = [m.keypoints.xyz for m in dataset[category] if _spans_volume(m.keypoints.xyz)]
            yield f"{category}, 7 keypoints", 1.0, partial(_keypointnet_problem, models)


def _keypointnet_problem(models: list[FloatArray], rng: np.random.Generator) -> SimulatedProblem:
    points = models[rng.integers(len(models))]
    chosen = points[rng.choice(len(points), 7, replace=False)]
    scale = np.array([1.0, *(1 / rng.uniform(*STRETCH_RANGE, 2))])
    alignment = Alignment(random_rotation(rng), [0.0, 0.0, rng.uniform(1.5, 3)], scale)
    return section.seen_in(KEYPOINT_CAMERA, alignment, chosen / scale, 1.0, rng)


def _spans_volume(points: FloatArray) -> bool:
    if len(points) < 7:
        return False
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[2] > 0.05 * sizes[0])


def _is_missed(problem: SimulatedProblem, noise: float, est: Alignment) -> bool:
    """True if a refinement from the truth ends at a better alignment."""
    camera = faced(problem.camera, problem.points_2d)
    truth, found = (
        turned_alignment(each, camera.lens_from_camera.T).packed
        for each in (problem.alignment, est)
    )
    rays = camera.normalize(problem.points_2d)
    whitening = whitening_of(noise, rays, camera)
    objective = keypoint_objective(problem.points_3d, rays, whitening)
    objective = objective._replace(scale_prior=BOUNDING_PRIOR)
    cost, _, _ = refine(objective, 200, truth)
    return bool(cost < evaluate_cost(objective, found) * (1 - 1e-6) - 1e-9)


def _speed(problem: SimulatedProblem, points: int, repetitions: int) -> Iterator[Row]:
    x, uv, camera = problem.points_3d, problem.points_2d, problem.camera
    rays, matrix = camera.normalize(uv), camera.matrix
    calls: dict[str, Callable[[], object]] = {
        "cv2 EPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_EPNP),
        "cv2 SQPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_SQPNP),
        "cv2 ITERATIVE": lambda: cv2.solvePnP(x, uv, matrix, None),
        "solvers.aepnp": lambda: aepnp(x, rays),
        "fit aepnp": lambda: cadalign.fit(x, uv, camera, method="aepnp"),
        "fit optimal": lambda: cadalign.fit(x, uv, camera),
        "fit aepnp-paper": lambda: cadalign.fit(x, uv, camera, method="aepnp-paper"),
    }
    medians = _medians(calls, repetitions)
    if points == 10:
        batch = np.tile(x, (_BATCH, 1, 1)), np.tile(uv, (_BATCH, 1, 1)), camera
        runs = {
            f"fit_batch aepnp, {name}": partial(
                cadalign.fit_batch, *batch, method="aepnp", workers=workers
            )
            for name, workers in {"1 thread": 1, "all cores": -1}.items()
        }
        medians |= {name: median / _BATCH for name, median in _medians(runs, 10).items()}
    for name in (*(each for each in medians if not each.startswith("cv2")), "cv2 SQPNP"):
        peer = "cv2 ITERATIVE" if name == "fit optimal" else "cv2 EPNP"
        ratio, label = medians[name] / medians[peer], f"{name}, {points} keypoints"
        yield section.figure(label, 1e6 * medians[name], "us", ratio, peer)


def _medians(calls: dict[str, Callable[[], object]], count: int) -> dict[str, float]:
    timed = {name: partial(section.seconds, call) for name, call in calls.items()}
    return section.medians_in_turns(timed, count, per_turn=10)


# Unknown focal length -----------------------------------------------------------------------------


def unknown_focal(
    given: BenchmarkData, *, problems: int = 1000, robust_problems: int = 40
) -> Tables:
    """Fits with an unknown focal length: accuracy against the Cramer-Rao bound, and outliers.

    Parameters
    ----------
    problems : int
        Random problems per row of accuracy.
    robust_problems : int
        Random problems per share of outliers.
    """
    title = "1 px: median errors over the Cramer-Rao limit's of 9 unknowns"
    yield title, [_accuracy(given.seed, n, problems) for n in (10, 20, 50, 200)]
    title = f"{_ROBUST_POINTS} points: none of the wrong kept, and over 90 % of the others"
    shares = (0.0, 0.3, 0.5, 0.7, 0.8)
    yield title, [_robust(given.seed, share, robust_problems) for share in shares]


def _accuracy(seed: int, points: int, problems: int) -> Row:
    rng = np.random.default_rng(seed)
    drawn = [simulate_problem(rng, points=points, noise_px=1.0) for _ in range(problems)]
    batch = cadalign.fit_batch(
        [problem.points_3d for problem in drawn],
        [problem.points_2d for problem in drawn],
        _UNKNOWN,
        focal="estimate",
        focal_prior=None,
        workers=-1,
    )
    errors = []
    for b, problem in enumerate(drawn):
        row = dict.fromkeys(_FOCAL_ERRORS, np.inf)
        if batch.solved[b]:
            row = alignment_errors(est=batch.alignment(b), gt=problem.alignment)
            row["focal_error"] = abs(batch.focal_length[b] / SIMULATION_CAMERA.fx - 1)
        errors.append(row)
    ideal = _ideal_errors(drawn, rng, sigma=1.0, focal="estimate")
    limit = {error: float(np.median(ideal[error])) for error in _FOCAL_ERRORS}
    ratios = {
        short: float(np.median([row[error] for row in errors])) / limit[error]
        for error, short in _FOCAL_ERRORS.items()
    }
    row = {"points": points, "limit f %": 100 * limit["focal_error"]}
    return {**row, **ratios, "failed %": section.percent(~batch.solved)}


def _robust(seed: int, share: float, robust_problems: int) -> Row:
    rng = np.random.default_rng(seed)
    found = 0
    for _ in range(robust_problems):
        problem = simulate_problem(rng, points=_ROBUST_POINTS, noise_px=1.0)
        true = problem.points_2d.copy()
        places = rng.uniform(true.min(axis=0), true.max(axis=0), true.shape)
        wrong = rng.permutation(_ROBUST_POINTS) < round(share * _ROBUST_POINTS)
        problem.points_2d[wrong] = places[wrong]
        moved = np.linalg.norm(problem.points_2d - true, axis=1)
        given = problem.points_3d, problem.points_2d, _UNKNOWN
        result = section.attempt(cadalign.fit, *given, focal="estimate", ransac=RansacOptions())
        if result is not None:
            # One that landed where it belongs is not wrong.
            is_kept = result.inliers[wrong & (moved > 15)].any()
            found += not is_kept and result.inliers[moved == 0].mean() > 0.9
    return {"wrong %": 100 * share, "found %": 100 * found / robust_problems}
