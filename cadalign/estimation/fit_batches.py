"""`fit_batch`: many problems solved in one call."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, copied
from cadalign.errors import CadalignError
from cadalign.estimation.assemble import keypoints_of_solution, result_of_keypoints
from cadalign.estimation.fit import check_search, diagnosis_of_fit, fit_one
from cadalign.estimation.focal import PriorOption
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma
from cadalign.estimation.problems import (
    Problems,
    Solutions,
    each_of,
    full_covariance,
    in_threads,
    pack_many,
)
from cadalign.estimation.result import Result
from cadalign.estimation.results import Results
from cadalign.estimation.solve import solve
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry

T = TypeVar("T")


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
    sigmas: Sequence[Sigma] | None = None
    if per_problem:
        sigmas = list(map(copied, each_of(sigma, "sigma", len(problems), "values")))
    check_search(ransac, scores, symmetry)
    if scores is not None:
        scores = each_of(scores, "scores", len(problems), "sets")
    if len({(each.width, each.height) for each in problems.cameras}) == 1:
        options = options.for_camera(problems.cameras[0])
    is_solved_at_once = ransac is None and options.focal == "known"
    is_solved_at_once &= not options.estimates_in_rounds

    @np.errstate(all="ignore")  # holds for one thread only
    def run(first: int, last: int) -> Results:
        some, start = problems.part(first, last), time.perf_counter()
        own = None if sigmas is None else sigmas[first:last]
        if is_solved_at_once:
            solutions = solve(some, options, own)
            solutions = solutions._replace(errors=dict(solutions.errors))  # which can be pickled
            seconds = (time.perf_counter() - start) / max(len(some), 1)
            batch = _SolvedBatch(some, solutions, options, own, symmetry, seconds)
            return batch.results()
        fits: list[Result | CadalignError] = []
        for b in range(first, last):
            start, one = time.perf_counter(), options
            if sigmas is not None:
                one = replace(options, sigma=sigmas[b])
            trusted = None if scores is None else scores[b]
            try:
                part = problems.part(b, b + 1)
                fits.append(fit_one(part, one, ransac, trusted, symmetry, start))
            except CadalignError as error:
                fits.append(error)
        unknowns = 10 if options.focal == "estimate" else 9
        return Results.of(fits, counts=some.counts, unknowns=unknowns)

    return Results.joined(in_threads(run, len(problems), workers))


@dataclass(frozen=True, eq=False)
class _SolvedBatch:
    """Problems of a batch that were solved at once.

    ``sigmas``, one for each problem, take the place of the options' sigma; ``seconds`` is the time
    of one problem.
    """

    problems: Problems
    solutions: Solutions
    options: FitOptions
    sigmas: Sequence[Sigma] | None
    symmetry: Symmetry | None
    seconds: float

    def single(self, b: int) -> Result:
        """The result of one problem that has a solution, as `cadalign.fit` gives it."""
        own: dict[str, Any] = {
            name: None if value is None else value[b : b + 1].copy()
            for name, value in self.solutions._asdict().items()
            if name not in ("residuals", "errors")
        }
        own["residuals"] = self.solutions.residuals[self.problems.rows(b)].copy()
        options, some = self.options, self.problems.part(b, b + 1)
        if self.sigmas is not None:
            options = replace(options, sigma=self.sigmas[b])
        fitted = keypoints_of_solution(some, Solutions(**own), options, self.seconds)
        return result_of_keypoints(
            some.points_2d, fitted, diagnosis=diagnosis_of_fit, symmetry=self.symmetry
        )

    def results(self) -> Results:
        """The results of all problems, which are made one at a time."""
        problems, errors = self.problems, dict(self.solutions.errors)
        if self.symmetry is not None:
            every = range(len(problems))
            found = [errors[b] if b in errors else self.single(b) for b in every]
            return Results.of(found, counts=problems.counts)
        failed = np.zeros(len(problems), dtype=bool)
        failed[list(errors)] = True
        inliers = np.repeat(~failed, problems.counts)
        residuals = np.where(inliers[:, None], self.solutions.residuals, np.nan)
        squares = np.append((residuals**2).sum(axis=1), 0.0)
        means = np.add.reduceat(squares, problems.offsets[:-1]) / np.maximum(problems.counts, 1)
        covariance = self.solutions.covariances
        if covariance is not None:
            covariance = full_covariance(covariance, self.options.known_axis)
            covariance[failed] = np.nan
        return Results(
            poses=np.where(failed[:, None], np.nan, self.solutions.poses[:, 0]),
            rms=np.where(failed, np.nan, np.sqrt(means)),
            focal_length=np.where(failed, np.nan, problems.calibrations[:, 0]),
            fisher_covariance=covariance,
            residuals=residuals,
            inliers=inliers,
            offsets=problems.offsets,
            errors=errors,
            single=self.single,
        )
