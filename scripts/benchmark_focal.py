"""Measure fits with an unknown focal length: accuracy against the Cramer-Rao bound, and outliers.

Prints tables and writes a JSON file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro
from common import SeededBenchmark, ideal_errors, new_table, write_results
from rich.console import Console

import cadalign
from cadalign import Camera, RansacOptions
from cadalign.errors import CadalignError
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.simulation.problems import SIMULATION_CAMERA, simulate_problem

UNKNOWN = Camera.without_focal(SIMULATION_CAMERA.width, SIMULATION_CAMERA.height)
ERRORS = (
    "rotation_error_deg",
    "translation_error",
    "scale_y_error",
    "scale_z_error",
    "focal_error",
)
SIZES = (10, 20, 50, 200)
WRONG_SHARES = (0.0, 0.3, 0.5, 0.7, 0.8)
ROBUST_POINTS = 100


@dataclass
class FocalArguments(SeededBenchmark):
    """Measure fits with an unknown focal length."""

    problems: int = 1000
    """Random problems per row of accuracy."""
    robust_problems: int = 40
    """Random problems per share of outliers."""


def main(arguments: FocalArguments) -> None:
    """Run all measurements."""
    console = Console(width=130)
    title = "1 px: median errors over the Cramer-Rao limit's of 9 unknowns"
    table = new_table(title, "points", "limit f %", "R", "t", "s_y", "s_z", "f", "failed")
    accuracy = [_accuracy(arguments, points) for points in SIZES]
    for row in accuracy:
        ratios = [f"{row['ratios'][error]:.2f}" for error in ERRORS]
        limit = f"{100 * row['limit_focal']:.2f}"
        table.add_row(str(row["points"]), limit, *ratios, f"{100 * row['failed']:.1f} %")
    console.print(table)
    robust = [_robust(arguments, share) for share in WRONG_SHARES]
    for row in robust:
        console.print(
            f"{ROBUST_POINTS} points, {100 * row['wrong']:.0f} % wrong: in "
            f"{100 * row['found']:.1f} % none of these was kept and over 90 % of the others"
        )
    write_results(arguments.out, {"accuracy": accuracy, "robust": robust})


def _accuracy(arguments: FocalArguments, points: int) -> dict[str, object]:
    """Median errors over those of an ideal estimator."""
    rng = np.random.default_rng(arguments.seed)
    problems = [
        simulate_problem(rng, points=points, noise_px=1.0) for _ in range(arguments.problems)
    ]
    batch = cadalign.fit_batch(
        [problem.points_3d for problem in problems],
        [problem.points_2d for problem in problems],
        UNKNOWN,
        focal="estimate",
        workers=-1,
    )
    errors = []
    for b, problem in enumerate(problems):
        row = dict.fromkeys(ERRORS, np.inf)
        if batch.solved[b]:
            row = alignment_errors(est=batch.alignment(b), gt=problem.alignment)
            row["focal_error"] = abs(batch.focal_length[b] / SIMULATION_CAMERA.fx - 1)
        errors.append(row)
    ideal = ideal_errors(problems, rng, sigma=1.0, focal="estimate")
    limit = {error: float(np.median(ideal[error])) for error in ERRORS}
    return {
        "points": points,
        "limit_focal": limit["focal_error"],
        "ratios": {
            error: float(np.median([row[error] for row in errors])) / limit[error]
            for error in ERRORS
        },
        "failed": float(1 - batch.solved.mean()),
    }


def _robust(arguments: FocalArguments, share: float) -> dict[str, float]:
    """Rate at which outliers are told from inliers."""
    rng = np.random.default_rng(arguments.seed)
    found = 0
    for _ in range(arguments.robust_problems):
        problem = simulate_problem(rng, points=ROBUST_POINTS, noise_px=1.0)
        points_2d = problem.points_2d.copy()
        places = rng.uniform(points_2d.min(axis=0), points_2d.max(axis=0), points_2d.shape)
        wrong = rng.permutation(ROBUST_POINTS) < round(share * ROBUST_POINTS)
        points_2d[wrong] = places[wrong]
        # One that landed where it belongs is not wrong.
        wrong &= np.linalg.norm(points_2d - problem.points_2d, axis=1) > 15
        try:
            result = cadalign.fit(
                problem.points_3d, points_2d, UNKNOWN, focal="estimate", ransac=RansacOptions()
            )
        except CadalignError:
            continue
        clean = np.linalg.norm(points_2d - problem.points_2d, axis=1) == 0
        found += not result.inliers[wrong].any() and result.inliers[clean].mean() > 0.9
    return {"wrong": share, "found": found / arguments.robust_problems}


if __name__ == "__main__":
    main(tyro.cli(FocalArguments))
