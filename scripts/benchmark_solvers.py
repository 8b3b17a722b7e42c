"""Measure the solvers: accuracy against the Cramer-Rao bound, speed against OpenCV.

Everything runs in one process on the same problems; speeds are ratios of medians, since machines
differ and are noisy. Prints tables and writes a JSON file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from timeit import repeat

import cv2
import numpy as np
import tyro
from common import SeededBenchmark, ideal_errors, new_table, write_results
from rich.console import Console

import cadalign
from cadalign.datasets import KeypointNet
from cadalign.errors import CadalignError
from cadalign.estimation.problems import whitening_of
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, STRETCH_RANGE
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.simulation.problems import Problem, random_rotation, simulate_problem
from cadalign.solvers.alignment import evaluate_cost, keypoint_objective
from cadalign.solvers.linear import aepnp
from cadalign.solvers.minimal import ap4p
from cadalign.solvers.refine import refine

ACCURACY_ROWS = ((6, 1.0), (7, 1.0), (10, 1.0), (20, 1.0), (100, 2.0), (1024, 2.0), (1024, 10.0))
SPEED_SIZES = (10, 100, 1024, 4096)
METHODS = ("optimal", "aepnp", "aepnp-paper")
ERRORS = ("rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error")
CALLS_PER_TURN = 10

Source = tuple[str, float, Callable[[np.random.Generator], Problem]]
"""Name, noise [px], and a function that draws a problem."""


@dataclass
class SolversArguments(SeededBenchmark):
    """Measure the solvers' accuracy and speed."""

    problems: int = 2000
    """Random problems per row."""
    repetitions: int = 300
    """Timed calls per figure; the median counts."""
    keypointnet: Path | None = None
    """Folder with KeypointNet's annotations, for rows on real keypoints."""


def main(arguments: SolversArguments) -> None:
    """Run all measurements."""
    console = Console(width=130)
    results = {
        "accuracy": list(_accuracy(arguments, console)),
        "minimal": _minimal(arguments, console),
        "speed": list(_speed(arguments, console)),
    }
    write_results(arguments.out, results)


def _accuracy(arguments: SolversArguments, console: Console) -> Iterator[dict[str, object]]:
    """Rows of errors over those of the limit."""
    title = "Errors over the Cramer-Rao limit's: median (90th percentile)"
    columns = ("problems", "limit R deg", "method", "R", "t", "s_y", "s_z", "failed", "missed")
    table = new_table(title, *columns)
    sources: list[Source] = [
        (f"{n} points, {noise:g} px", noise, partial(simulate_problem, points=n, noise_px=noise))
        for n, noise in ACCURACY_ROWS
    ]
    if arguments.keypointnet is not None:
        sources += _keypointnet_sources(arguments.keypointnet)
    for name, noise, draw in sources:
        rng = np.random.default_rng(arguments.seed)
        problems = [draw(rng) for _ in range(arguments.problems)]
        limit = ideal_errors(problems, rng, sigma=noise, focal="known")
        for method in METHODS:
            row = _accuracy_row(problems, noise, method, limit) | {"problems": name}
            table.add_row(
                name,
                "{:.2f} ({:.2f})".format(*row["limit_rotation_deg"]),
                method,
                *("{:.2f} ({:.2f})".format(*row["ratios"][error]) for error in ERRORS),
                f"{100 * row['failed']:.2f} %",
                "" if row["missed"] is None else f"{100 * row['missed']:.2f} %",
            )
            yield row
    console.print(table)


def _keypointnet_sources(root: Path) -> Iterator[Source]:
    dataset = KeypointNet(root)
    for category in ("chair", "bottle", "airplane"):
        if category in dataset.categories:
            models = [m.keypoints.xyz for m in dataset[category] if _spans_volume(m.keypoints.xyz)]
            yield f"{category}, 7 keypoints", 1.0, partial(_keypointnet_problem, models)


def _keypointnet_problem(models: list[np.ndarray], rng: np.random.Generator) -> Problem:
    points = models[rng.integers(len(models))]
    chosen = points[rng.choice(len(points), 7, replace=False)]
    scale = np.array([1.0, *(1 / rng.uniform(*STRETCH_RANGE, 2))])
    alignment = cadalign.Alignment(random_rotation(rng), [0.0, 0.0, rng.uniform(1.5, 3)], scale)
    pixels = KEYPOINT_CAMERA.project(alignment.apply(chosen / scale))
    pixels += rng.standard_normal(pixels.shape)
    return Problem(chosen / scale, pixels, KEYPOINT_CAMERA, alignment, None)


def _spans_volume(points: np.ndarray) -> bool:
    if len(points) < 7:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] > 0.05 * spread[0])


def _accuracy_row(
    problems: list[Problem], noise: float, method: str, limit: dict[str, np.ndarray]
) -> dict[str, object]:
    errors = []
    failed = missed = 0
    for problem in problems:
        try:
            sigma = noise if method == "optimal" else 1.0
            result = cadalign.fit(
                problem.points_3d, problem.points_2d, problem.camera, method=method, sigma=sigma
            )
        except CadalignError:
            failed += 1
            errors.append([180.0, np.inf, np.inf, np.inf])
            continue
        found = alignment_errors(est=result.alignment, gt=problem.alignment)
        errors.append([found[error] for error in ERRORS])
        missed += method == "optimal" and _is_missed(problem, noise, result.alignment)
    levels = (50, 90)
    table = np.array(errors)
    ratios = {
        error: (np.percentile(table[:, k], levels) / np.percentile(limit[error], levels)).tolist()
        for k, error in enumerate(ERRORS)
    }
    return {
        "method": method,
        "limit_rotation_deg": np.percentile(limit["rotation_error_deg"], levels).tolist(),
        "median_rotation_deg": float(np.median(table[:, 0])),
        "ratios": ratios,
        "failed": failed / len(problems),
        "missed": missed / len(problems) if method == "optimal" else None,
    }


def _is_missed(problem: Problem, noise: float, est: cadalign.Alignment) -> bool:
    """True if a refinement from the truth ends at a better alignment."""
    rays = problem.camera.normalize(problem.points_2d)
    whitening = whitening_of(noise, rays, problem.camera)
    objective = keypoint_objective(problem.points_3d, rays, whitening)
    cost, _, _ = refine(objective, 200, problem.alignment.packed)
    return bool(cost < evaluate_cost(objective, est.packed) * (1 - 1e-6) - 1e-9)


def _minimal(arguments: SolversArguments, console: Console) -> dict[str, float]:
    """Rate of the truth among the minimal solver's solutions, and their number."""
    rng = np.random.default_rng(arguments.seed)
    found = solutions = 0
    for _ in range(arguments.problems):
        problem = simulate_problem(rng, points=4, noise_px=0.0)
        rays = problem.camera.normalize(problem.points_2d)
        rotations, translations, scales = ap4p(problem.points_3d, rays)
        poses = np.concatenate([rotations.reshape(-1, 9), translations, scales], axis=1)
        solutions += len(poses)
        found += (np.abs(poses - problem.alignment.packed) < 1e-4).all(axis=1).any()
    result = {
        "truth_found": found / arguments.problems,
        "mean_solutions": solutions / arguments.problems,
    }
    console.print(
        f"4 points: the truth is among the solutions in {100 * result['truth_found']:.2f} %, "
        f"{result['mean_solutions']:.2f} solutions on average"
    )
    return result


def _speed(arguments: SolversArguments, console: Console) -> Iterator[dict[str, object]]:
    """Medians of running times as ratios to OpenCV's."""
    title = "Time over OpenCV's (which does not stretch): ratios of medians"
    table = new_table(title, "points", "what", "microseconds", "over", "ratio")
    rng = np.random.default_rng(arguments.seed)
    for points in SPEED_SIZES:
        problem = simulate_problem(rng, points=points, noise_px=1.0)
        for row in _speed_rows(problem, points, arguments.repetitions):
            table.add_row(
                str(points),
                str(row["what"]),
                f"{row['microseconds']:.1f}",
                str(row["peer"]),
                f"{row['ratio']:.2f}",
            )
            yield row
    console.print(table)


def _speed_rows(problem: Problem, points: int, repetitions: int) -> Iterator[dict[str, object]]:
    x, uv, camera = problem.points_3d, problem.points_2d, problem.camera
    rays, matrix = camera.normalize(uv), camera.matrix
    timed: dict[str, Callable[[], object]] = {
        "cv2 EPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_EPNP),
        "cv2 SQPNP": lambda: cv2.solvePnP(x, uv, matrix, None, flags=cv2.SOLVEPNP_SQPNP),
        "cv2 ITERATIVE": lambda: cv2.solvePnP(x, uv, matrix, None),
        "solvers.aepnp": lambda: aepnp(x, rays),
        "fit aepnp": lambda: cadalign.fit(x, uv, camera, method="aepnp"),
        "fit optimal": lambda: cadalign.fit(x, uv, camera),
        "fit aepnp-paper": lambda: cadalign.fit(x, uv, camera, method="aepnp-paper"),
    }
    medians = _interleaved_medians(timed, repetitions)
    if points == 10:
        count = 10_000
        xs, uvs = np.tile(x, (count, 1, 1)), np.tile(uv, (count, 1, 1))
        for name, workers in {"1 thread": 1, "all cores": -1}.items():
            run = partial(cadalign.fit_batch, xs, uvs, camera, method="aepnp", workers=workers)
            name = f"fit_batch aepnp, {name}"
            medians[name] = _interleaved_medians({name: run}, 9)[name] / count
    ours = [name for name in medians if not name.startswith("cv2")]
    for name in (*ours, "cv2 SQPNP"):
        peer = "cv2 ITERATIVE" if name == "fit optimal" else "cv2 EPNP"
        yield {
            "points": points,
            "what": name,
            "microseconds": 1e6 * medians[name],
            "peer": peer,
            "peer_microseconds": 1e6 * medians[peer],
            "ratio": medians[name] / medians[peer],
        }


def _interleaved_medians(
    timed: dict[str, Callable[[], object]], repetitions: int
) -> dict[str, float]:
    """Median seconds of each function, as a loop over it would see them.

    They take turns of a few calls, so that a slow moment of the machine hits all alike.
    """
    times: dict[str, list[float]] = {name: [] for name in timed}
    for function in timed.values():
        function()
    for _ in range(-(-repetitions // CALLS_PER_TURN)):
        for name, function in timed.items():
            times[name] += repeat(function, number=1, repeat=CALLS_PER_TURN)
    return {name: float(np.median(values)) for name, values in times.items()}


if __name__ == "__main__":
    main(tyro.cli(SolversArguments))
