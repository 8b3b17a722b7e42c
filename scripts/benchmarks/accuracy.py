"""Accuracy of the solvers against the Cramer-Rao bound, and their speed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import cv2
import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Camera, RansacOptions
from cadalign.arrays import FloatArray
from cadalign.evaluation.metrics.errors import alignment_errors, scaled_columns
from cadalign.evaluation.simulation import (
    SIMULATION_CAMERA,
    SimulatedProblem,
    simulate_problem,
)
from cadalign.geometry.camera import projection_jacobian
from cadalign.metrics import rotation_error
from cadalign.solvers.linear import aepnp

_ROWS = ((6, 1.0), (7, 1.0), (10, 1.0), (20, 1.0), (100, 2.0), (1024, 2.0), (1024, 10.0))
_BATCH = 10_000
_METHODS = ("optimal", "aepnp", "aepnp-paper")
_TITLE = "Rotation, median (90th percentile): the bound, and errors over it"
_UNKNOWN = Camera.without_focal(SIMULATION_CAMERA.width, SIMULATION_CAMERA.height)
_ROBUST_POINTS = 100
_SCALE_X, _FOCAL = 6, 9  # rows of a bound


def accuracy(given: BenchmarkData) -> Tables:
    """Accuracy against the Cramer-Rao bound, with known and unknown focal lengths."""
    yield from _solvers(given)
    yield from _unknown_focal(given)


# Known focal length -------------------------------------------------------------------------------


def _solvers(given: BenchmarkData) -> Tables:
    """Accuracy against the Cramer-Rao bound, speed against OpenCV.

    Everything runs in one process on the same problems; speeds are ratios of medians.
    """
    rows = []
    for points, noise in _ROWS:
        rows.append(_over_bound(points, noise, given.count or 2000, given.seed))
    yield _TITLE, rows
    rng = np.random.default_rng(given.seed)
    problems = [simulate_problem(rng, points=n, noise_px=1.0) for n in (10, 100, 1024, 4096)]
    yield "Time over OpenCV's, which does not stretch", [r for p in problems for r in _speed(p)]


def _over_bound(points: int, noise: float, count: int, seed: int) -> Row:
    """Rotation errors of an ideal estimator, and those of every method relative to them."""
    rng = np.random.default_rng(seed)
    problems = [simulate_problem(rng, points=points, noise_px=noise) for _ in range(count)]
    ideal = _ideal_errors(problems, rng, sigma=noise, focal="known")["rotation_error_deg"]
    row: Row = {"problems": f"{points} points, {noise:g} px", "bound, deg": section.spread(ideal)}
    for method in _METHODS:
        sigma = noise if method == "optimal" else 1.0
        results = [section.fitted(each, method=method, sigma=sigma) for each in problems]
        errors = [
            180.0 if found is None else rotation_error(est=found.alignment, gt=each.alignment)
            for each, found in zip(problems, results, strict=True)
        ]
        ratios = np.divide(section.spread(errors), row["bound, deg"])
        row[method] = tuple(ratios.tolist())
    return row


def _ideal_errors(
    problems: list[SimulatedProblem], rng: np.random.Generator, *, sigma: float, focal: str
) -> dict[str, FloatArray]:
    """Errors of an ideal estimator on all problems, by name; see `cramer_rao_bound`."""
    draws = []
    for each in problems:
        bound = section.attempt(cramer_rao_bound, each, sigma=sigma, focal=focal)
        if bound is not None:
            draws.append(sample_limit(bound, rng=rng, draws=section.LIMIT_DRAWS))
    return {error: np.concatenate([draw[error] for draw in draws]) for error in draws[0]}


def cramer_rao_bound(problem: SimulatedProblem, *, sigma: float, focal: str) -> FloatArray:
    """The least covariance of an unbiased estimate: inverse of the Fisher information at the truth.

    As `cadalign.Result.covariance`, (9, 9) or (10, 10); ``focal`` is that of `cadalign.fit`.
    """
    size = _FOCAL + 1 if focal == "estimate" else _FOCAL
    used = [row for row in range(size) if row != _SCALE_X]
    jacobian = projection_jacobian(problem.points_3d, problem.camera, problem.alignment)
    scaled, norms = scaled_columns(jacobian[:, :, used].reshape(-1, len(used)) / sigma)
    covariance = np.zeros((size, size))
    covariance[np.ix_(used, used)] = np.linalg.inv(scaled.T @ scaled) / np.outer(norms, norms)
    return covariance


def sample_limit(
    bound: FloatArray, *, rng: np.random.Generator, draws: int
) -> dict[str, FloatArray]:
    """Errors of an ideal estimator: draws from a Gaussian with the bound as its covariance.

    By name, each (draws,) float in the units of `cadalign.metrics`; ``focal_error``, relative, only
    if the focal length is unknown.
    """
    errors = np.zeros((draws, len(bound)))
    free = np.flatnonzero(bound.diagonal())
    own, mean = bound[np.ix_(free, free)], np.zeros(len(free))
    errors[:, free] = rng.multivariate_normal(mean, own, size=draws, method="eigh")
    focal = {"focal_error": np.abs(np.expm1(errors[:, _FOCAL]))} if len(bound) > _FOCAL else {}
    return focal | {
        "rotation_error_deg": np.degrees(np.linalg.norm(errors[:, :3], axis=1)),
        "translation_error": np.linalg.norm(errors[:, 3:6], axis=1),
        "scale_y_error": np.abs(np.expm1(errors[:, 7])),
        "scale_z_error": np.abs(np.expm1(errors[:, 8])),
    }


def _speed(problem: SimulatedProblem) -> Iterator[Row]:
    x, uv, camera = problem.points_3d, problem.points_2d, problem.camera
    rays, matrix = camera.normalize(uv), camera.matrix
    calls: dict[str, Callable[[], object]] = {
        "cv2 EPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_EPNP),
        "cv2 ITERATIVE": lambda: cv2.solvePnP(x, uv, matrix, None),
        "solvers.aepnp": lambda: aepnp(x, rays),
        "fit aepnp": lambda: cadalign.fit(x, uv, camera, method="aepnp"),
        "fit optimal": lambda: cadalign.fit(x, uv, camera),
    }
    medians = _medians(calls, 300)
    if len(x) == 10:
        batch = np.tile(x, (_BATCH, 1, 1)), np.tile(uv, (_BATCH, 1, 1)), camera
        run = partial(cadalign.fit_batch, *batch, method="aepnp", workers=1)
        medians["fit_batch aepnp, 1 thread"] = _medians({"": run}, 10)[""] / _BATCH
    for name in (each for each in medians if not each.startswith("cv2")):
        peer = "cv2 ITERATIVE" if name == "fit optimal" else "cv2 EPNP"
        ratio, label = medians[name] / medians[peer], f"{name}, {len(x)} keypoints"
        yield section.figure(label, 1e6 * medians[name], "us", ratio, peer)


def _medians(calls: dict[str, Callable[[], object]], count: int) -> dict[str, float]:
    timed = {name: partial(section.seconds, call) for name, call in calls.items()}
    return section.medians_in_turns(timed, count, per_turn=10)


# Unknown focal length -----------------------------------------------------------------------------


def _unknown_focal(given: BenchmarkData) -> Tables:
    """Fits with an unknown focal length: accuracy against the Cramer-Rao bound, and outliers."""
    title = "1 px: median errors over the Cramer-Rao bound's of 9 unknowns"
    count = given.count or 1000
    yield title, [_accuracy(given.seed, n, count) for n in (10, 20, 50, 200)]
    title = f"{_ROBUST_POINTS} points: none of the wrong kept, and over 90 % of the others"
    shares = (0.0, 0.3, 0.5, 0.7, 0.8)
    yield title, [_robust(given.seed, share, given.count or 40) for share in shares]


def _accuracy(seed: int, points: int, problems: int) -> Row:
    rng = np.random.default_rng(seed)
    drawn = [simulate_problem(rng, points=points, noise_px=1.0) for _ in range(problems)]
    places, pixels = ([getattr(p, name) for p in drawn] for name in ("points_3d", "points_2d"))
    how: dict[str, Any] = {"focal": "estimate", "focal_prior": None, "workers": -1}
    batch = cadalign.fit_batch(places, pixels, _UNKNOWN, **how)
    ideal = _ideal_errors(drawn, rng, sigma=1.0, focal="estimate")
    errors = []
    for b, problem in enumerate(drawn):
        row = dict.fromkeys(ideal, np.inf)
        if batch.solved[b]:
            row = alignment_errors(est=batch.alignment(b), gt=problem.alignment)
            row["focal_error"] = abs(batch.focal_length[b] / SIMULATION_CAMERA.fx - 1)
        errors.append(row)
    ratios = {
        name.removesuffix("_deg").removesuffix("_error"): float(
            np.median([row[name] for row in errors]) / np.median(ideal[name])
        )
        for name in ideal
    }
    return {"points": points, **ratios, "failed %": section.percent(~batch.solved)}


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
