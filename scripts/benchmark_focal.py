"""Measure fits with an unknown focal length: accuracy against the Cramer-Rao bound, and outliers.

Prints tables and writes a JSON file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import cadalign
from cadalign import Camera, RansacOptions, metrics
from cadalign.errors import CadalignError
from cadalign.evaluation.accuracy.cramer_rao import cramer_rao_bound, sample_limit
from cadalign.evaluation.simulation.problems import SIMULATION_CAMERA, Problem, simulate_problem
from cadalign.io.files import write_json

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
LIMIT_DRAWS = 20


@dataclass
class Arguments:
    """Measure fits with an unknown focal length."""

    out: Path = Path("bench/focal.json")
    """JSON file to write."""
    problems: int = 1000
    """Random problems per row of accuracy."""
    robust_problems: int = 40
    """Random problems per share of outliers."""
    seed: int = 0
    """Seed of the problems."""


def main(arguments: Arguments) -> None:
    """Run all measurements."""
    console = Console(width=130)
    table = Table(title="1 px: median errors over the Cramer-Rao limit's of 9 unknowns")
    for column in ("points", "limit f %", "R", "t", "s_y", "s_z", "f", "failed"):
        table.add_column(column, justify="right")
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
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out, {"accuracy": accuracy, "robust": robust})
    console.print(f"written to {arguments.out}")


def _accuracy(arguments: Arguments, points: int) -> dict[str, object]:
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
    errors, limits = [], []
    for b, problem in enumerate(problems):
        bound = cramer_rao_bound(
            problem.points_3d, SIMULATION_CAMERA, problem.alignment, sigma=1.0, focal="estimate"
        )
        draws = sample_limit(bound, rng=rng, draws=LIMIT_DRAWS)
        limits.append([draws[error] for error in ERRORS])
        errors.append(_errors(problem, batch, b) if batch.solved[b] else [np.inf] * len(ERRORS))
    limit = np.median(np.concatenate(limits, axis=1), axis=1)
    ratios = np.median(errors, axis=0) / limit
    return {
        "points": points,
        "limit_focal": float(limit[-1]),
        "ratios": dict(zip(ERRORS, ratios.tolist(), strict=True)),
        "failed": float(1 - batch.solved.mean()),
    }


def _errors(problem: Problem, batch: cadalign.BatchResult, b: int) -> list[float]:
    est, gt = batch.alignment(b), problem.alignment
    _, scale_y, scale_z = metrics.scale_error(est=est, gt=gt)
    return [
        metrics.rotation_error(est=est, gt=gt),
        metrics.translation_error(est=est, gt=gt),
        scale_y,
        scale_z,
        abs(batch.focal_length[b] / SIMULATION_CAMERA.fx - 1),
    ]


def _robust(arguments: Arguments, share: float) -> dict[str, float]:
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
    main(tyro.cli(Arguments))
