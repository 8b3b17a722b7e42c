"""`align`: the object's pose, stretch and shape from all that is known about it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, DegenerateError, InputError, quote
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.pack import evidence_of
from cadalign.fitting.joint.plain import align_plain, is_plain
from cadalign.fitting.joint.prior import ShapePrior, prior_of
from cadalign.fitting.joint.result import AlignAlternative, AlignResult
from cadalign.fitting.joint.robust import Consensus, find_consensus, state_of
from cadalign.fitting.joint.starts import starts_of
from cadalign.fitting.joint.view import View
from cadalign.fitting.joint.warnings import warnings_of
from cadalign.fitting.options import LOSSES, FitOptions, RansacOptions
from cadalign.fitting.result import FitStats
from cadalign.geometry.alignment import Alignment
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import Evidence, State, points_of
from cadalign.solvers.joint.search import joint_covariance, search_joint

_LEAST_LIKELIHOOD = 1e-3


class _Minimum(NamedTuple):
    component: int
    inliers: BoolArray
    evidence: Evidence
    state: State
    cost: float
    score: float


@np.errstate(all="ignore")  # what is not finite is refused
def align(
    model: Model | ShapeModel,
    views: View | Sequence[View],
    *,
    loss: str = "linear",
    loss_scale: float = 2.0,
    ransac: RansacOptions | None = None,
) -> AlignResult:
    """Estimate an object's pose, stretch and shape from one or more views.

    Parameters
    ----------
    model : Model or ShapeModel
        One CAD model, exact, stretched, or only similar (``shape_sigma``); or the learned shape of
        a category.
    views : View or sequence of View
        What the images tell. Views with ``cam_from_rig`` share one pose and determine the object's
        size; views without it have a pose each and share the stretch and the shape.
    loss, loss_scale
        As for `cadalign.fit`.
    ransac : RansacOptions, optional
        Search for the keypoints that agree, for views with outliers; of its options,
        ``max_reproj_error`` and ``seed`` count where the shape is not exact.

    Returns
    -------
    AlignResult

    Raises
    ------
    InputError
        If an argument is invalid, or a view names a keypoint that the model lacks.
    DegenerateError
        If the keypoints are too few, or no estimate has them all in front of the cameras.

    Examples
    --------
    A box of which the model's proportions are known to some 5 % of its size:

    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> truth = Alignment(np.diag([1.0, -1.0, -1.0]), [0.3, 0.2, 6.0], np.ones(3))
    >>> photo = camera.project(truth.apply(corners * [1.0, 1.1, 0.95]))
    >>> result = align(Model(points_3d=corners, shape_sigma=0.05), View(camera, photo))
    >>> result.points_3d.shape, len(result.warnings)
    ((8, 3), 0)
    """
    start = time.perf_counter()
    given = [views] if isinstance(views, View) else list(views)
    _check_views(given)
    options = FitOptions(loss=loss, loss_scale=loss_scale)
    if is_plain(model, given):
        exact = cast(Model, model)
        return align_plain(exact, given[0], loss=loss, loss_scale=loss_scale, ransac=ransac)
    prior = prior_of(model)
    minima: list[_Minimum] = []
    iterations = hypotheses = 0
    for number, shape in enumerate(prior.components):
        evidence = evidence_of(
            prior, shape, given, loss=LOSSES[options.loss], loss_scale=options.loss_scale
        )
        if ransac is None:
            found, used, tried = _search(evidence)
        else:
            threshold = _thresholds(evidence, given, ransac.max_reproj_error)
            found, used, tried = find_consensus(evidence, threshold, int(ransac.seed))
        iterations, hypotheses = iterations + used, hypotheses + tried
        prior_score = -2 * float(np.log(prior.weights[number]))
        minima.extend(
            _Minimum(number, *each._replace(score=each.score + prior_score)) for each in found
        )
    if not minima:
        raise DegenerateError(
            "no pose has the keypoints in front of the camera",
            where="views",
            fix="give at least 3 keypoints in one view, and check which is which",
        )
    minima.sort(key=lambda minimum: minimum.score)
    stats = FitStats(iterations, hypotheses, time.perf_counter() - start)
    return _result(model, prior, given, minima, stats)


def align_batch(
    model: Model | ShapeModel,
    objects: Sequence[View | Sequence[View]],
    *,
    loss: str = "linear",
    loss_scale: float = 2.0,
    ransac: RansacOptions | None = None,
    workers: int = 1,
) -> list[AlignResult | CadalignError]:
    """Align many objects of one kind; each as `align` does, bit for bit.

    Parameters
    ----------
    model, loss, loss_scale, ransac
        As for `align`.
    objects : sequence of View or of sequences of View
        The views of every object.
    workers : int
        Number of threads that share the objects; -1 for all cores.

    Returns
    -------
    list of AlignResult or CadalignError
        The error takes the place of the result where an object has none.

    Raises
    ------
    InputError
        If workers is invalid.
    """
    if not isinstance(workers, int | np.integer) or (workers < 1 and workers != -1):
        what = f"must be >= 1, or -1 for all cores, not {quote(workers)}"
        raise InputError(what, where="workers")

    def one(views: View | Sequence[View]) -> AlignResult | CadalignError:
        try:
            return align(model, views, loss=loss, loss_scale=loss_scale, ransac=ransac)
        except CadalignError as error:
            return error

    if workers == 1:
        return [one(views) for views in objects]
    with ThreadPoolExecutor(None if workers == -1 else int(workers)) as pool:
        return list(pool.map(one, objects))


def _search(evidence: Evidence) -> tuple[list[Consensus], int, int]:
    """Minima of all sightings together, and the effort they took."""
    poses, log_scales = starts_of(evidence)
    if not len(poses):
        return [], 0, 0
    minima, count, iterations = search_joint(evidence, poses, log_scales)
    all_of_them = np.ones(len(evidence.sightings.point), dtype=bool)
    found = [
        Consensus(
            all_of_them,
            evidence,
            state_of(minima, k),
            float(minima.costs[k]),
            float(minima.scores[k]),
        )
        for k in range(count)
    ]
    return found, iterations, len(poses)


def _thresholds(evidence: Evidence, views: Sequence[View], max_reproj_error: float) -> FloatArray:
    """Largest whitened residuals (N,) of inliers."""
    sightings = evidence.sightings
    focal = np.array([np.sqrt(view.camera.fx * view.camera.fy) for view in views])
    root = np.sqrt(sightings.whitening[:, 0] * sightings.whitening[:, 2])
    return max_reproj_error / focal[sightings.image] * root


def _check_views(views: Sequence[object]) -> None:
    if not views:
        raise InputError("none is given", where="views")
    for number, view in enumerate(views):
        if not isinstance(view, View):
            what = f"expected a cadalign.View, got {type(view).__name__}"
            raise InputError(what, where=f"views[{number}]")


def _result(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[_Minimum],
    stats: FitStats,
) -> AlignResult:
    best = minima[0]
    unknowns, of_points = joint_covariance(best.evidence, best.state)
    points, scale = _points(best)
    poses = _poses(best, scale)
    covariance, stretch = _of_stretch(best, unknowns)
    residuals = []
    for view, pose in zip(views, poses, strict=True):
        rows = prior.rows_of(view.keypoint_ids, "ids")
        seen = view.camera.project(pose.apply(points[rows]))
        residuals.append(seen - cast(FloatArray, view.points_2d))
    alternatives = []
    for other in minima[1:]:
        likelihood = float(np.exp((best.score - other.score) / 2))
        if likelihood >= _LEAST_LIKELIHOOD:
            own, own_scale = _points(other)
            pose = _poses(other, own_scale)[0]
            alternatives.append(AlignAlternative(pose, own[:-2], own[-2:], likelihood))
    return AlignResult(
        alignment=poses[0],
        ids=prior.ids,
        points_3d=points[:-2],
        bounds=points[-2:],
        poses=poses,
        residuals=tuple(residuals),
        inliers=_inliers(prior, views, best),
        covariance=covariance,
        points_covariance=of_points[:-2],
        stretch=stretch,
        component=best.component,
        model=model,
        alternatives=tuple(alternatives),
        warnings=warnings_of(best.evidence, best.cost, poses, stretch, covariance),
        stats=stats,
    )


def _inliers(prior: ShapePrior, views: Sequence[View], minimum: _Minimum) -> tuple[BoolArray, ...]:
    """The inliers of every view, in its own order of keypoints."""
    names = np.concatenate([prior.rows_of(view.keypoint_ids, "ids") for view in views])
    kept = np.empty(len(names), dtype=bool)
    kept[np.argsort(names, kind="stable")] = minimum.inliers
    ends = np.cumsum([len(view.keypoint_ids) for view in views])
    return tuple(np.split(kept, ends[:-1]))


def _points(minimum: _Minimum) -> tuple[FloatArray, FloatArray]:
    """Points (m + 2, 3) before the stretch, and the stretch (3,)."""
    scale = np.exp(minimum.state.log_scales)
    return points_of(minimum.evidence.shape, minimum.state) / scale, scale


def _poses(minimum: _Minimum, scale: FloatArray) -> tuple[Alignment, ...]:
    """Alignments in every view's camera."""
    rig = minimum.evidence.rig
    poses = []
    for camera, p in zip(rig.cam_from_rig, rig.pose, strict=True):
        pose = minimum.state.poses[p]
        rotation = camera[:9].reshape(3, 3)
        turned = rotation @ pose[:9].reshape(3, 3)
        poses.append(Alignment(turned, rotation @ pose[9:] + camera[9:], scale))
    return tuple(poses)


def _of_stretch(minimum: _Minimum, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance (9, 9) of pose and log lengths, and the lengths relative to the mean's (3,)."""
    shape, state = minimum.evidence.shape, minimum.state
    rig = minimum.evidence.rig
    rotation = rig.cam_from_rig[0][:9].reshape(3, 3)
    first = 6 * int(rig.pose.max() + 1)
    rows = np.zeros((9, len(unknowns)))
    pose = 6 * int(rig.pose[0])
    rows[:3, pose : pose + 3] = rotation
    rows[3:6, pose + 3 : pose + 6] = rotation
    mean = shape.mean[-1] - shape.mean[-2]
    modes = shape.modes[:, -1] - shape.modes[:, -2]
    extent = mean + state.coefficients @ modes
    safe = np.where(np.abs(extent) > 0, extent, np.inf)
    own = np.zeros(9)
    for axis in range(3):
        rows[6 + axis, first + axis] = 1.0
        rows[6 + axis, first + 3 :] = modes[:, axis] / safe[axis]
        own[6 + axis] = (shape.spread[-2:] ** 2).sum() / safe[axis] ** 2
    stretch = np.exp(state.log_scales) * extent / np.where(mean != 0, mean, 1.0)
    return rows @ unknowns @ rows.T + np.diag(own), np.where(mean != 0, stretch, 1.0)
