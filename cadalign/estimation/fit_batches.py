"""`fit_batch`: many problems solved in one call."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, copied
from cadalign.errors import CadalignError
from cadalign.estimation.fit import check_search, fit_one
from cadalign.estimation.focal import PriorOption
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma, pixel_information
from cadalign.estimation.problems import (
    Problems,
    each_of,
    in_threads,
    joined,
    pack_many,
    pack_one,
)
from cadalign.estimation.result import Result
from cadalign.estimation.results import COLUMNS, Entry, Results
from cadalign.estimation.solve import are_solved_at_once, solve
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.solvers.constants import POSE_SIZE


def fit_batch(
    points_3d: Sequence[npt.ArrayLike] | FloatArray,
    points_2d: Sequence[npt.ArrayLike] | FloatArray,
    camera: Camera | Sequence[Camera],
    *,
    method: str = FitOptions.method,
    sigma: Sigma | Sequence[Sigma] | None = FitOptions.sigma,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    stretch: str | None = FitOptions.stretch,
    stretch_sigma: float | None = FitOptions.stretch_sigma,
    known_axis: str = FitOptions.known_axis,
    focal: str = FitOptions.focal,
    focal_prior: PriorOption = FitOptions.focal_prior,
    ransac: RansacOptions | None = None,
    scores: Sequence[npt.ArrayLike] | None = None,
    symmetry: Symmetry | None = None,
    workers: int = 1,
) -> Results:
    """Solve many independent problems in one call; each as `fit` does, bit for bit.

    Parameters
    ----------
    points_3d : (B, n, 3) float or sequence of B (n_b, 3) float
        Model points of every problem.
    points_2d : (B, n, 2) float or sequence of B (n_b, 2) float
        Image points of every problem [px].
    camera : Camera or sequence of B Camera
        One for all problems, or one each.
    sigma : float, None, or sequence of B
        As for `fit`, for all problems; a sequence gives each problem its own.
    method, loss, loss_scale, stretch, stretch_sigma, known_axis, focal, focal_prior
        As for `fit`; every problem has a focal length of its own.
    ransac
        As for `fit`.
    scores : sequence of B (n_b,) float, optional
        As for `fit`, for each problem.
    symmetry : Symmetry, optional
        As for `fit`, of all models.
    workers : int
        Number of threads that share the problems; -1 for all cores.

    Returns
    -------
    Results
        Arrays over the problems, and a sequence of their `Result`; a problem without solution has
        its error there, and does not stop the others.

    Raises
    ------
    InputError
        If the arguments of any problem, or an option, are invalid.

    Examples
    --------
    >>> import numpy as np
    >>> from cadalign.evaluation.simulation import simulate_problem
    >>> rng = np.random.default_rng(1)
    >>> problems = [simulate_problem(rng, points=n, noise_px=1.0) for n in (8, 20)]
    >>> batch = fit_batch(
    ...     [p.points_3d for p in problems], [p.points_2d for p in problems], problems[0].camera
    ... )
    >>> batch.scale.shape
    (2, 3)
    """
    per_problem = isinstance(sigma, list | tuple) or np.ndim(sigma) > 0  # type: ignore[arg-type]
    given: Any = 1.0 if per_problem else sigma
    shape, lens = (stretch, stretch_sigma, known_axis), (focal, focal_prior)
    options = FitOptions(method, given, loss, loss_scale, *shape, *lens)
    problems = pack_many(points_3d, points_2d, camera)
    count = len(problems)
    each_options = [options] * count
    if per_problem:
        sigmas = list(map(copied, each_of(sigma, "sigma", count, "values")))
        for one, problem in zip(sigmas, problems, strict=True):
            if one is not None:
                pixel_information(one, len(problem.points_3d))
        each_options = [replace(options, sigma=one) for one in sigmas]
    check_search(ransac, scores, symmetry)
    if scores is not None:
        scores = each_of(scores, "scores", count, "sets")
    is_alone = per_problem or ransac is not None or symmetry is not None
    is_alone |= not are_solved_at_once(problems, options)
    entries: list[Any] = [None] * count
    table = np.full((count, COLUMNS), np.nan)

    def fit_alone(b: int) -> Result | CadalignError:
        start, trusted = time.perf_counter(), None if scores is None else scores[b]
        try:
            return fit_one(problems[b], each_options[b], ransac, trusted, symmetry, start)
        except CadalignError as error:
            return error

    @np.errstate(all="ignore")  # holds for one thread only
    def run(first: int, last: int) -> None:
        if is_alone:
            entries[first:last] = map(fit_alone, range(first, last))
        else:
            entries[first:last], table[first:last] = _solve_at_once(problems[first:last], options)

    in_threads(run, count, workers)
    return Results(entries, None if is_alone else table)


def _solve_at_once(each: Sequence[Problems], options: FitOptions) -> tuple[list[Entry], FloatArray]:
    """The entries of `Results`, each made when it is asked for, and their table (B, 17)."""
    problems = joined(each)
    solutions = solve(problems, options)
    squares = np.append((solutions.residuals**2).sum(axis=1), 0.0)
    means = np.add.reduceat(squares, problems.offsets[:-1]) / np.maximum(problems.counts, 1)
    table = np.empty((len(problems), COLUMNS))
    table[:, :POSE_SIZE] = solutions.poses[:, 0]
    table[:, POSE_SIZE], table[:, POSE_SIZE + 1] = np.sqrt(means), problems.camera.fx
    errors = solutions.errors
    table[list(errors)] = np.nan
    return [
        errors.get(b) or partial(_single, problems, b, options) for b in range(len(each))
    ], table


def _single(problems: Problems, b: int, options: FitOptions) -> Result:
    """The result of problem ``b``, which has a solution: that of `cadalign.fit`."""
    start, rows = time.perf_counter(), problems.rows(b)
    one = pack_one(problems.points_3d[rows], problems.points_2d[rows], problems.camera)
    return fit_one(one, options, None, None, None, start)
