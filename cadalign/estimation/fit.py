"""Estimate alignments from matched 3D and 2D keypoints: `fit` and `fit_batch`."""

from __future__ import annotations

import os
import time
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, copy_argument
from cadalign.errors import CadalignError, InputError, NoConsensusError, require_kind
from cadalign.estimation.assemble import result_of_keypoints
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma, pixel_information
from cadalign.estimation.problems import (
    Problems,
    entry_per_problem,
    first_rows,
    join_problems,
    pack_many,
    pack_one,
    run_in_threads,
)
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import EstimateWarning, FittedKeypoints
from cadalign.estimation.results import COLUMNS, Entry, Results
from cadalign.estimation.solve import are_solved_at_once, fit_keypoints, solve
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry, check_symmetry
from cadalign.io.focal import PriorOption
from cadalign.solvers.constants import POSE_SIZE


@np.errstate(all="ignore")  # non-finite results are refused
def fit(
    points_3d: npt.ArrayLike,
    points_2d: npt.ArrayLike,
    camera: Camera,
    *,
    method: str = FitOptions.method,
    sigma: Sigma | None = FitOptions.sigma,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    stretch: str | None = FitOptions.stretch,
    stretch_sigma: float | None = FitOptions.stretch_sigma,
    focal: str = FitOptions.focal,
    focal_prior: PriorOption = FitOptions.focal_prior,
    ransac: RansacOptions | None = None,
    scores: npt.ArrayLike | None = None,
    symmetry: Symmetry | None = None,
) -> Result:
    """Estimate rotation, translation and stretch of a model from its keypoints in one image.

    Parameters
    ----------
    points_3d : (n, 3) float
        Keypoints on the model, in the model's coordinates.
    points_2d : (n, 2) float
        The same keypoints in the image [px]; integers are pixel centres.
    camera : Camera
        The calibrated camera, with its lens distortion. With ``focal="estimate"`` its focal length
        is ignored: `Camera.from_size` has none.
    method : {"optimal", "aepnp", "aepnp-paper", "epnp"}
        - ``optimal``: global search for the maximum-likelihood alignment; at least 5 points. With
          4 points, all alignments that reproject exactly, the least stretched first.
        - ``aepnp``: the linear solver, see `cadalign.solvers.aepnp`; at least 6 points.
        - ``aepnp-paper``: the solver of the AEPnP paper, as published; at least 6 points.
        - ``epnp``: OpenCV's EPnP, which does not stretch the model; at least 4 points.
    sigma : float, (n,) float, (n, 2, 2) float or None
        Standard deviation of all keypoints or of each [px], or covariance of each [px^2]. None
        estimates it from the residuals. Use None for a model that is only similar to the object:
        the shapes then differ by more than the pixel noise.
    loss : {"linear", "huber", "cauchy"}
        Loss function of a residual's length: its square, or a robust loss.
    loss_scale : float
        Scale of a robust loss [sigma].
    stretch : str, optional
        Axes whose scale is estimated: ``"yz"`` (the default), ``"y"``, ``"z"`` or ``"none"``. All
        other scales are 1. The scale of x is always 1, since one image does not separate size from
        distance.
    stretch_sigma : float, optional
        Standard deviation of a Gaussian prior on the logarithm of each scale, about the scale 1.
        Needed for keypoints in one plane or seen end-on. The default prior is flat from 1/5 to 5
        and falls off beyond: it only bounds scales that the keypoints do not determine.
    focal : {"known", "estimate"}
        Use the camera's focal length, or estimate it as a ninth unknown, which needs 5 points.
        ``result.camera`` has the estimate. Principal point and pixel aspect ratio are never
        estimated.
    focal_prior : FocalPrior, "usual" or None
        Prior on the estimated focal length, for example from `FocalPrior.from_exif`. The default
        covers usual lenses, see `FocalPrior.from_size`. None for no prior.
    ransac : RansacOptions, optional
        Robust search, for keypoints with outliers: find the alignment with the most inliers, then
        fit to these. ``result.inliers`` marks them. For an unknown focal length
        see `cadalign.align`.
    scores : (n,) float, optional
        Confidences of the keypoints, for ``ransac``: the weights of every second sample.
    symmetry : Symmetry, optional
        Motions that map the model to itself. Of all equivalent alignments, the result is the
        canonical one: nearest to upright (y up), with the model's z axis towards the camera.
        The others are no alternatives. ``result.points_3d`` are the keypoints of the canonical
        alignment. A stretch that differs between the two directions across an axis leaves only half
        turns about it; ``stretch="y"`` keeps all turns about y. See `cadalign.geometry.symmetry`.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, or an option is invalid.
    DegenerateError
        If there are too few points, they don't determine the alignment (the message names the
        part), or no solution has all points in front of the camera.
    NoConsensusError
        With ``ransac``: if no alignment has more inliers than chance explains.

    Examples
    --------
    >>> import numpy as np
    >>> from cadalign.evaluation.simulation import simulate_problem
    >>> problem = simulate_problem(np.random.default_rng(1), points=10, noise_px=0.0)
    >>> result = fit(problem.points_3d, problem.points_2d, problem.camera)
    >>> bool(np.allclose(result.alignment.scale, problem.alignment.scale))
    True

    The same photo without its focal length, which is 150 px:

    >>> camera = Camera.from_size(640, 480)
    >>> unknown = {"focal": "estimate", "focal_prior": None}
    >>> result = fit(problem.points_3d, problem.points_2d, camera, **unknown)
    >>> round(result.camera.fx, 3)
    150.0
    """
    start = time.perf_counter()
    chosen: Any = (method, sigma, loss, loss_scale, stretch, stretch_sigma, focal, focal_prior)
    try:
        options = _checked_options(*chosen)
    except InputError:
        raise
    except (TypeError, ValueError):  # an array as sigma has no hash
        options = FitOptions(method, copy_argument(sigma), *chosen[2:])
    problems = pack_one(points_3d, points_2d, camera)
    check_search(ransac, scores, symmetry)
    return fit_one(problems, options, ransac, scores, symmetry, start)


@np.errstate(all="ignore")
def check_search(ransac: object, scores: object, symmetry: Symmetry | None) -> None:
    if ransac is not None:
        require_kind(ransac, RansacOptions, "ransac")
    elif scores is not None:
        fix = "give ransac=RansacOptions(...), or the keypoints' sigma instead"
        raise InputError("given without ransac", where="scores", fix=fix)
    if symmetry is not None:
        check_symmetry(symmetry)


def fit_one(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions | None,
    scores: npt.ArrayLike | None,
    symmetry: Symmetry | None,
    start: float,
    labels: Sequence[Hashable] = (),
    photo: str | os.PathLike[str] | None = None,
    **fields: Any,
) -> Result:
    """Fit one problem; the time starts at ``start`` [s].

    Warnings name keypoints by ``labels``, by default their rows. If the ``photo`` has the camera's
    size, no warning suggests another size. `result_of_keypoints` takes ``fields``.
    """
    try:
        fitted = fit_once(problems, options, ransac, scores, start)
    except NoConsensusError as error:
        from cadalign.estimation.diagnose import case_of_fit, diagnose_refusal  # needs fit itself

        given = problems.points_3d, problems.points_2d, problems.camera
        case = case_of_fit(*given, options, ransac, sorted(set(first_rows(problems))) or None)
        error.fix = diagnose_refusal(case) or error.fix
        raise
    return result_of_keypoints(
        problems.points_2d,
        fitted,
        diagnosis=partial(diagnosis_of_fit, labels=tuple(labels), photo=photo),
        symmetry=symmetry,
        **fields,
    )


def diagnosis_of_fit(fitted: FittedKeypoints, **given: Any) -> EstimateWarning | None:
    from cadalign.estimation.diagnose import diagnose_fit  # rarely asked

    return diagnose_fit(fitted, **given)


def fit_once(
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions | None,
    scores: npt.ArrayLike | None,
    start: float,
) -> FittedKeypoints:
    """Fit one problem, without a diagnosis of its residuals."""
    if firsts := first_rows(problems):
        return _fit_distinct(firsts, problems, options, ransac, scores, start)
    options = options.for_camera(problems.camera)
    if ransac is None:
        return fit_keypoints(problems, options, start)
    # Imported here: most programs never search for outliers, and its kernels import slowly.
    from cadalign.estimation.consensus import fit_robustly

    return fit_robustly(problems, options, ransac, scores, start)


def _fit_distinct(
    firsts: Sequence[int],
    problems: Problems,
    options: FitOptions,
    ransac: RansacOptions | None,
    scores: npt.ArrayLike | None,
    start: float,
) -> FittedKeypoints:
    """Fit the rows ``firsts``; repeated keypoints have residuals, but are no inliers."""
    rows, points, pixels = sorted(set(firsts)), problems.points_3d.copy(), problems.points_2d
    own = options.for_keypoints(rows)
    scores = None if scores is None else np.asarray(scores)[rows]
    some = pack_one(points[rows], pixels[rows], problems.camera)
    found, kept = fit_once(some, own, ransac, scores, start), np.zeros(len(points), dtype=bool)
    kept[rows] = found.inliers
    residuals = found.camera.project_where_ahead(found.alignment.apply(points)) - pixels
    return replace(
        found,
        points_3d=points,
        alternatives=tuple(replace(each, points_3d=points) for each in found.alternatives),
        residuals=residuals,
        inliers=kept,
        options=replace(found.options, sigma=options.sigma),
        repeats=tuple((row, first) for row, first in enumerate(firsts) if row != first),
    )


# Checking options takes as long as a linear solver, and calls often repeat the options.
_checked_options = lru_cache(maxsize=64, typed=True)(FitOptions)


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
    focal: str = FitOptions.focal,
    focal_prior: PriorOption = FitOptions.focal_prior,
    ransac: RansacOptions | None = None,
    scores: Sequence[npt.ArrayLike] | None = None,
    symmetry: Symmetry | None = None,
    workers: int = 1,
) -> Results:
    """Solve many independent problems in one call, with the same results as `fit`, bit for bit.

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
    method, loss, loss_scale, stretch, stretch_sigma, focal, focal_prior
        As for `fit`. Estimated focal lengths differ between problems.
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
        Arrays over the problems, and a sequence of one `Result` or error each. A problem without
        solution does not stop the others.

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
    options = FitOptions(
        method, given, loss, loss_scale, stretch, stretch_sigma, focal, focal_prior
    )
    problems = pack_many(points_3d, points_2d, camera)
    count = len(problems)
    each_options = [options] * count
    if per_problem:
        sigmas = list(map(copy_argument, entry_per_problem(sigma, "sigma", count, "values")))
        for one, problem in zip(sigmas, problems, strict=True):
            if one is not None:
                pixel_information(one, len(problem.points_3d))
        each_options = [replace(options, sigma=one) for one in sigmas]
    check_search(ransac, scores, symmetry)
    if scores is not None:
        scores = entry_per_problem(scores, "scores", count, "sets")
    is_alone = per_problem or ransac is not None or symmetry is not None
    is_alone |= not are_solved_at_once(problems, options) or any(map(first_rows, problems))
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

    run_in_threads(run, count, workers)
    return Results(entries, None if is_alone else table)


def _solve_at_once(each: Sequence[Problems], options: FitOptions) -> tuple[list[Entry], FloatArray]:
    """Entries of `Results`, computed on access, and their table (B, 17)."""
    problems = join_problems(each)
    solutions = solve(problems, options)
    squares = np.append((solutions.residuals**2).sum(axis=1), 0.0)
    means = np.add.reduceat(squares, problems.offsets[:-1]) / np.maximum(problems.counts, 1)
    table = np.empty((len(problems), COLUMNS))
    table[:, :POSE_SIZE] = solutions.poses[:, 0]
    table[:, POSE_SIZE], table[:, POSE_SIZE + 1] = np.sqrt(means), problems.camera.fx
    errors = solutions.errors
    table[list(errors)] = np.nan
    return [
        errors.get(b) or partial(_fit_row, problems, b, options) for b in range(len(each))
    ], table


def _fit_row(problems: Problems, b: int, options: FitOptions) -> Result:
    """The result of `cadalign.fit` for problem ``b``, which has a solution."""
    start, rows = time.perf_counter(), problems.rows(b)
    one = pack_one(problems.points_3d[rows], problems.points_2d[rows], problems.camera)
    return fit_one(one, options, None, None, None, start)
