"""Estimate an object's pose, stretch and shape from all evidence: `align` and `align_batch`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar, cast

import numpy as np

from cadalign.arrays import FloatArray, worker_count
from cadalign.errors import (
    CadalignError,
    DegenerateError,
    InputError,
    NoConsensusError,
    quote,
    require_kind,
)
from cadalign.estimation.agreement import DiagnosisCase
from cadalign.estimation.diagnose import diagnose, diagnose_refusal
from cadalign.estimation.estimates import single_posterior, undo_turns
from cadalign.estimation.fit import fit_one
from cadalign.estimation.joint import add_diagnosis, result_of, result_of_minima
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.pack import seen_keypoints
from cadalign.estimation.prior import Lenses, prior_of
from cadalign.estimation.problem import Problem, compile_problem, no_pose_error
from cadalign.estimation.problems import entry_per_problem, pack_one
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import LEAST_LIKELIHOOD, NO_NOTES, FitStats
from cadalign.estimation.results import Results
from cadalign.estimation.search import search, widen_by_noise
from cadalign.estimation.view import View, number_views
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import rotate_alignment
from cadalign.io.evidence import Size
from cadalign.io.focal import PriorOption
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import inflation_with
from cadalign.solvers.constants import LEAST_POINTS
from cadalign.solvers.marginal.equations import POSE_UNKNOWNS
from cadalign.solvers.marginal.problem import Mixture
from cadalign.solvers.marginal.search import search_view

T = TypeVar("T")


@np.errstate(all="ignore")  # non-finite results are refused
def align(
    model: Model | ShapeModel,
    views: View | Sequence[View],
    *,
    size: Size | None = None,
    init: Alignment | Sequence[Alignment | None] | None = None,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    ransac: RansacOptions | None = None,
    focal: str = FitOptions.focal,
    focal_prior: PriorOption = FitOptions.focal_prior,
) -> Result:
    """Estimate an object's pose, stretch and shape from one or more views.

    Parameters
    ----------
    model : Model or ShapeModel
        One CAD model, exact up to a stretch or only similar (``shape_sigma``); or the learned shape
        of a category.
    views : View or sequence of View
        Evidence of each image. Views with ``cam_from_rig`` share one pose and determine the
        object's size. Views without it have one pose each, and share the stretch and the shape.
        In a rig, views with masks need no keypoints. A single mask without keypoints needs
        ``init``, or an exact model with a mesh.
    size : Size, optional
        Known lengths of the object.
    init : Alignment or sequence of Alignment or None, optional
        Additional start of the search, needed if there are too few keypoints to find one: the
        alignment in the rig's frame or, without ``cam_from_rig``, in the first camera's frame. A
        sequence has one start, or None, for each view.
    loss, loss_scale
        As for `cadalign.fit`.
    ransac : RansacOptions, optional
        Robust search, for keypoints with outliers. If the shape is not exact or the focal length is
        unknown, each sample (4 keypoints, or 6 with ``minimal="aepnp"``) is aligned by the search
        itself, and ``refine=False`` refines only once on the inliers.
    focal : {"known", "estimate"}
        Use the cameras' focal lengths, or estimate them. Views with equal cameras share one focal
        length. ``result.cameras`` have the estimates.
    focal_prior : FocalPrior, "usual" or None
        Prior on the estimated focal lengths, as for `cadalign.fit`.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If an argument is invalid, or a view names a keypoint that the model lacks.
    DegenerateError
        If there are too few keypoints, or no estimate has all of them in front of the cameras.
    NoConsensusError
        With ``ransac``: if no estimate has more inliers than chance explains.

    Examples
    --------
    A box whose shape is known to about 5 % of its size:

    >>> from cadalign import Alignment, Camera
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> truth = Alignment(np.diag([-1.0, -1.0, 1.0]), [0.3, 0.2, 6.0], np.ones(3))
    >>> photo = camera.project(truth.apply(corners * [1.0, 1.1, 0.95]))
    >>> result = align(Model(points_3d=corners, shape_sigma=0.05), View(camera, photo))
    >>> result.points_3d.shape, round(result.std.scale[2], 2)
    ((8, 3), 0.19)
    """
    start = time.perf_counter()
    given = _resolve_names(model, number_views(_checked_views(views)))
    if size is not None:
        require_kind(size, Size, "size")
    inits = _checked_inits(init, given)
    options = FitOptions(loss=loss, loss_scale=loss_scale, focal=focal, focal_prior=focal_prior)
    Lenses.from_views(given, focal, focal_prior)  # checks the cameras
    _check_numbers(model, given)
    if size is None and init is None and _is_plain(model, given):
        exact = cast(Model, model)
        return _align_plain(exact, given[0], options=options, ransac=ransac)
    problem = compile_problem(model, given, size, inits, options, ransac)

    def estimate(
        model: Model | ShapeModel,
        views: Sequence[View],
        /,
        size: Size | None = size,
        ransac: RansacOptions | None = ransac,
        **changes: Any,
    ) -> Result:
        some, own = [None] * len(views), replace(options, **changes)
        return _estimate(compile_problem(model, views, size, some, own, ransac), start)

    seen = [given[number] for number in problem.numbers]
    photo, is_tolerant = given[0].photo, loss != FitOptions.loss
    case = DiagnosisCase(model, seen, estimate, ransac, size, photo=photo, is_tolerant=is_tolerant)
    try:
        result = _estimate(problem, start)
    except (NoConsensusError, DegenerateError) as error:
        named = diagnose_refusal(case, with_keypoints=isinstance(error, NoConsensusError))
        error.fix = named or error.fix
        raise
    return add_diagnosis(result, partial(diagnose, case, result=result), problem.views, ransac)


def _resolve_names(model: object, views: list[View]) -> list[View]:
    """Replace names of keypoints by the ids of a learned shape."""
    if not isinstance(model, ShapeModel):
        return views
    ids = [model.resolve(each.keypoint_ids, where=f"views[{each.number}].ids") for each in views]
    return [
        view if own == view.keypoint_ids else replace(view, ids=own)
        for view, own in zip(views, ids, strict=True)
    ]


def _estimate(problem: Problem, start: float) -> Result:
    """Run all stages of an estimate; the time starts at ``start`` [s]."""
    if _is_single(problem):
        return _align_single(problem, start)
    starts = [problem.inits]
    if problem.is_mask_alone:
        from cadalign.estimation.contours.silhouettes import starts_of_mask  # with OpenCV

        problem, starts = problem._replace(ransac=None), starts_of_mask(problem)
    problem, found, iterations, hypotheses = search(problem, starts)
    if not found:
        raise no_pose_error(problem)
    minima, notes = found, NO_NOTES
    if problem.uses_outlines:
        from cadalign.estimation.contours.engine import refine  # with OpenCV and embree

        minima, notes = refine(problem, found)
    stats = FitStats(iterations, hypotheses, time.perf_counter() - start)
    likely = widen_by_noise(problem, minima)
    return result_of_minima(problem, likely, stats, notes=notes)


def _is_plain(model: object, views: Sequence[View]) -> bool:
    """True if the only evidence is one view's keypoints, and the model is exact."""
    return is_exact_model(model) and len(views) == 1 and not views[0].sources


def _is_single(problem: Problem) -> bool:
    """True if the only evidence is one view's keypoints, and the model is a learned shape."""
    if problem.numbers != [0] or not isinstance(problem.model, ShapeModel):
        return False
    view = problem.views[0]
    if view.sources or view.sigma is None or len(view.keypoint_ids) < LEAST_POINTS:
        return False
    return problem.size is None and problem.ransac is None and not problem.lenses.count


def _align_plain(
    model: Model, view: View, *, options: FitOptions, ransac: RansacOptions | None
) -> Result:
    """The result of `fit`, with all keypoints of the model."""
    start, points = time.perf_counter(), cast(FloatArray, model.points_3d)
    rows = prior_of(model).rows_of(view.keypoint_ids, "views[0].ids")
    shape = model.stretch, model.stretch_sigma
    own = replace(options, sigma=view.sigma, stretch=shape[0], stretch_sigma=shape[1])
    problems = pack_one(points[rows], view.pixels, view.camera)
    scores = view.scores if ransac is not None else None
    labels = () if view.is_numbered else view.keypoint_ids
    search = ransac, scores, model.symmetry, start, labels, view.photo
    return fit_one(problems, own, *search, model=model, view=view)


def _align_single(problem: Problem, start: float) -> Result:
    """Align a learned shape to one view's keypoints; the time starts at ``start`` [s]."""
    model, view, options = cast(ShapeModel, problem.model), problem.views[0], problem.options
    starts = np.empty((0, 12))
    if problem.inits[0] is not None:
        init = rotate_alignment(problem.inits[0], problem.turns[0].T)
        starts = np.append(init.rotation, init.translation / init.scale.mean())[None]
    rows = problem.prior.rows_of(view.keypoint_ids, f"views[{view.number}].ids")
    weights, means, covariances = model.gaussians
    mixture = Mixture(means, covariances, -2 * np.log(weights))
    seen = seen_keypoints(view, view.pixels, rows, options)
    minima, hypotheses = search_view(mixture, seen, starts)
    count, iterations = minima.counts.tolist()
    if not count:
        raise no_pose_error(problem)
    stats = FitStats(iterations, hypotheses, time.perf_counter() - start)
    likelihoods = np.exp((minima.scores[0] - minima.scores[:count]) / 2)
    likelihoods = likelihoods[likelihoods >= LEAST_LIKELIHOOD]
    inflation = inflation_with(len(rows), model.inflation, model.few_keypoints)
    kept = zip(likelihoods.tolist(), minima.label.tolist(), minima.states, strict=False)
    boxes = model if covariances.any() else None
    estimates = [
        single_posterior(mixture, component, seen, state, inflation, boxes)._replace(
            likelihood=likelihood, cameras=(view.camera,)
        )
        for likelihood, component, state in kept
    ]
    component, cost = int(minima.label[0]), float(minima.costs[0])

    return result_of(
        problem,
        [undo_turns(each, problem) for each in estimates],
        inliers=[np.ones(len(rows), dtype=bool)],
        is_curved=bool(covariances.any()),
        redundancy=2 * len(rows) - POSE_UNKNOWNS,
        cost=cost,
        score=float(minima.scores[0]),
        stats=stats,
        component=component,
        stretched_axes="",
    )


def align_batch(
    model: Model | ShapeModel,
    objects: Sequence[View | Sequence[View]],
    *,
    size: Size | Sequence[Size | None] | None = None,
    init: Alignment | Sequence[Alignment | None] | None = None,
    loss: str = FitOptions.loss,
    loss_scale: float = FitOptions.loss_scale,
    ransac: RansacOptions | None = None,
    focal: str = FitOptions.focal,
    focal_prior: PriorOption = FitOptions.focal_prior,
    workers: int = 1,
) -> Results:
    """Align many objects of one kind, with the same results as `align`, bit for bit.

    Parameters
    ----------
    model, loss, loss_scale, ransac, focal, focal_prior
        As for `align`. Estimated focal lengths differ between objects.
    objects : sequence of View or of sequences of View
        The views of every object.
    size, init
        As for `align`: one for all objects, or a sequence with one or None for each.
    workers : int
        Number of threads that share the objects; -1 for all cores.

    Returns
    -------
    Results
        A `Result`, or the error, for each object; ``to_dataframe`` makes a table of them.

    Raises
    ------
    InputError
        If workers is invalid, or the number of sizes or starts is not the number of objects.

    Examples
    --------
    >>> from cadalign import Camera
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> truth = Alignment(np.diag([-1.0, -1.0, 1.0]), [0.3, 0.2, 6.0], np.ones(3))
    >>> view = View(camera, camera.project(truth.apply(corners)))
    >>> boxes = align_batch(Model(points_3d=corners), [view, view], size=[None, Size(width=2.0)])
    >>> [round(float(box.alignment.scale[0]), 3) for box in boxes]
    [1.0, 2.0]
    """
    threads = worker_count(workers)
    objects = entry_per_problem(objects, "objects", None, "views")
    sizes = _repeat(size, len(objects), "size", Size, "objects")
    starts = _repeat(init, len(objects), "init", Alignment, "objects")

    options: dict[str, Any] = {
        "loss": loss,
        "loss_scale": loss_scale,
        "ransac": ransac,
        "focal": focal,
        "focal_prior": focal_prior,
    }

    def one(
        views: View | Sequence[View], size: Size | None, init: Alignment | None
    ) -> Result | CadalignError:
        try:
            return align(model, views, size=size, init=init, **options)
        except CadalignError as error:
            return error

    if threads == 1:
        return Results([one(*each) for each in zip(objects, sizes, starts, strict=True)])
    with ThreadPoolExecutor(threads) as pool:
        return Results(list(pool.map(one, objects, sizes, starts)))


def _repeat(
    given: T | Sequence[T | None] | None, count: int, where: str, kind: type[T], of: str
) -> list[T | None]:
    """A list of ``count`` arguments, from one for all or a sequence."""
    if given is None or isinstance(given, kind):
        return [given] * count
    if not isinstance(given, Sequence):
        what = f"expected a cadalign.{kind.__name__} or a sequence of them"
        raise InputError(f"{what}, got {type(given).__name__}", where=where)
    if len(given) != count:
        fix = "give one for all, or a list with one or None for each"
        raise InputError(f"{len(given)} given for {count} {of}", where=where, fix=fix)
    for number, each in enumerate(given):
        if each is not None and not isinstance(each, kind):
            what = f"expected a cadalign.{kind.__name__} or None, got {type(each).__name__}"
            raise InputError(what, where=f"{where}[{number}]")
    return list(given)


def _checked_views(given: object) -> list[View]:
    if isinstance(given, View):
        return [given]
    if not isinstance(given, Iterable):
        what = f"expected a cadalign.View or several, got {type(given).__name__}"
        raise InputError(what, where="views", fix="give the model first, then the views")
    views = list(given)
    if not views:
        raise InputError("no views are given", where="views")
    for number, view in enumerate(views):
        require_kind(view, View, f"views[{number}]")
    return views


def _check_numbers(model: object, views: Sequence[View]) -> None:
    """Refuse views without ids unless they show all keypoints, with ids 0, 1, 2, ..."""
    known = model.ids if isinstance(model, Model | ShapeModel) else ()
    for number, view in enumerate(views):
        count = len(view.keypoint_ids)
        if not (known and count and view.is_numbered) or known == tuple(range(count)):
            continue
        what = f"{count} keypoints without ids, but the model has {len(known)}"
        if count == len(known):
            listed = ", ".join(map(quote, known[:5])) + (", ..." if count > 5 else "")
            what = f"no ids are given, and the model's keypoints are not 0, 1, 2, ... but {listed}"
        fix = "give the model's id of each keypoint of the view, in the view's order"
        raise InputError(what, where=f"views[{number}].ids", fix=fix)


def _checked_inits(init: Any, views: Sequence[View]) -> list[Alignment | None]:
    """A start or None for each view; a single start is the first view's."""
    given = _repeat(init, len(views), "init", Alignment, "views")
    if init is None or isinstance(init, Alignment) or views[0].cam_from_rig is not None:
        known = next((each for each in given if each is not None), None)  # a rig has one pose
        return [known, *[None] * (len(views) - 1)]
    return given
