"""Measure how often stated deviations hold, and how often large errors come without a warning.

Problems are the simulation's (f = 150 px). An error is large from 15 deg or 25 % of a scale, and
silent without warning and alternative. Prints tables and writes a JSON file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import tyro
from common import SeededBenchmark, new_table, write_results
from rich.console import Console
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from cadalign import Alignment, RansacOptions, Result, fit
from cadalign.errors import CadalignError
from cadalign.evaluation.simulation.problems import Problem, simulate_problem

LARGE_ROTATION_DEG, LARGE_SCALE = 15.0, 0.25
COVERED = 0.95
SIZES = (5, 6, 7, 8, 10, 20, 50, 100)

Draw = Callable[[np.random.Generator], Problem]


@dataclass
class CalibrationArguments(SeededBenchmark):
    """Measure the calibration of uncertainties and warnings."""

    problems: int = 1000
    """Random problems per row."""
    noise_px: float = 1.0
    """Standard deviation of the noise [px], which sigma states."""


def main(arguments: CalibrationArguments) -> None:
    """Measure and write the figures."""
    console = Console()
    results = {"coverage": _coverage(arguments, console), "warnings": _warnings(arguments, console)}
    write_results(arguments.out, results)


def _coverage(arguments: CalibrationArguments, console: Console) -> list[dict[str, Any]]:
    columns = ("sigma", "loss", "keypoints", "inverse Fisher", "stated", "no alternative")
    table = new_table("Errors within the 95 % ellipsoid [%]", *columns)
    rows = []
    for sigma, loss in ((arguments.noise_px, "linear"), (None, "linear"), (None, "cauchy")):
        for points in SIZES[1:]:
            draw = partial(simulate_problem, points=points, noise_px=arguments.noise_px)
            shares = np.mean(
                [
                    [_holds(result, problem.alignment, covariance) for covariance in stated]
                    + [not result.alternatives]
                    for problem, result in _fits(arguments, draw, sigma=sigma, loss=loss)
                    if (stated := (result.fisher_covariance, result.covariance))
                ],
                axis=0,
            )
            row = {"sigma": sigma, "loss": loss, "keypoints": points}
            row |= dict(zip(("fisher", "stated", "alone"), shares.tolist(), strict=True))
            table.add_row(str(sigma), loss, str(points), *(f"{100 * s:.1f}" for s in shares))
            rows.append(row)
    console.print(table)
    return rows


def _warnings(arguments: CalibrationArguments, console: Console) -> list[dict[str, Any]]:
    columns = ("data", "fits", "large errors", "silent", "silent %", "misfits %")
    table = new_table("Large errors without a warning, and misfits found", *columns)
    rows = []
    for name, draw, options in _cases(arguments.noise_px):
        fits = [
            (_is_large(result.alignment, problem.alignment), result)
            for problem, result in _fits(arguments, draw, **options)
        ]
        large = [result for is_large, result in fits if is_large]
        silent = sum(not result.warnings and not result.alternatives for result in large)
        misfits = sum(result.misfit is not None for _, result in fits) / max(len(fits), 1)
        row = {"data": name, "fits": len(fits), "large": len(large), "silent": silent}
        rows.append(row | {"misfits": misfits})
        share = f"{100 * silent / max(len(large), 1):.1f}"
        table.add_row(name, *map(str, list(row.values())[1:]), share, f"{100 * misfits:.2f}")
    console.print(table)
    return rows


def _cases(noise_px: float) -> list[tuple[str, Draw, dict[str, Any]]]:
    """Names, problems and options of `fit`; first wrong data, then right ones."""

    def draw(points: int, change: Callable[..., Any] | None = None, **options: Any) -> Draw:
        def problem_of(rng: np.random.Generator) -> Problem:
            problem = simulate_problem(rng, points=points, noise_px=noise_px, **options)
            if change is not None:
                change(rng, problem.points_2d)
            return problem

        return problem_of

    given = {"sigma": noise_px}
    return [
        ("1 wrong of 8", draw(8, _misplace), given),
        ("2 swapped of 12", draw(12, _swap), given),
        ("20 shuffled", draw(20, _shuffle), given),
        ("10, stretch none", draw(10), given | {"stretch": "none"}),
        ("1 wrong of 8, cauchy", draw(8, _misplace), given | {"loss": "cauchy"}),
        *((f"{points} right", draw(points), given) for points in SIZES),
        ("8 right, cauchy", draw(8), given | {"loss": "cauchy"}),
        ("8 right, prior", draw(8), given | {"scale_prior_sigma": 0.5}),
        ("8 right, covariances", draw(8), {"sigma": np.tile(noise_px**2 * np.eye(2), (8, 1, 1))}),
        ("8 right, focal unknown", draw(8), given | {"focal": "estimate"}),
        ("20 right, RANSAC", draw(20), given | {"ransac": RansacOptions(max_iterations=300)}),
    ]


def _misplace(rng: np.random.Generator, points_2d: np.ndarray) -> None:
    points_2d[rng.integers(len(points_2d))] = rng.uniform(0, (640, 480))


def _swap(rng: np.random.Generator, points_2d: np.ndarray) -> None:
    pair = rng.choice(len(points_2d), 2, replace=False)
    points_2d[pair] = points_2d[pair[::-1]]


def _shuffle(rng: np.random.Generator, points_2d: np.ndarray) -> None:
    rng.shuffle(points_2d)


def _fits(
    arguments: CalibrationArguments, draw: Draw, **options: Any
) -> list[tuple[Problem, Result]]:
    """Problems with their fits; those that are refused are left out."""
    fits = []
    for number in range(arguments.problems):
        problem = draw(np.random.default_rng([arguments.seed, number]))
        try:
            result = fit(problem.points_3d, problem.points_2d, problem.camera, **options)
        except CadalignError:
            continue
        fits.append((problem, result))
    return fits


def _is_large(est: Alignment, gt: Alignment) -> bool:
    angle = np.degrees(Rotation.from_matrix(gt.rotation @ est.rotation.T).magnitude())
    return bool(angle > LARGE_ROTATION_DEG or np.abs(est.scale / gt.scale - 1).max() > LARGE_SCALE)


def _holds(result: Result, gt: Alignment, covariance: np.ndarray | None) -> bool:
    """True if the truth lies within the 95 % ellipsoid."""
    assert covariance is not None
    est = result.alignment
    vector = Rotation.from_matrix(gt.rotation @ est.rotation.T).as_rotvec()
    shift, log_ratio = gt.translation - est.translation, np.log(gt.scale / est.scale)
    free = np.flatnonzero(covariance.diagonal())
    error = np.concatenate([vector, shift, log_ratio])[free]
    square = error @ np.linalg.solve(covariance[np.ix_(free, free)], error)
    return bool(square < chdtri(len(error), 1 - COVERED))


if __name__ == "__main__":
    main(tyro.cli(CalibrationArguments))
