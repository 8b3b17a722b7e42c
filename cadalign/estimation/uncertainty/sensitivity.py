"""Sensitivity of results: of fits in closed form, of all other evidence by differences.

That is the derivatives of a result by its keypoints, their sigmas, and the model's points.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray, is_whole
from cadalign.errors import InputError, quote
from cadalign.estimation.estimates import mean_state, placed_box, poses_of
from cadalign.estimation.facing import faced, turned_alignment
from cadalign.estimation.focal import log_focal_range
from cadalign.estimation.joint_robust import with_sightings
from cadalign.estimation.model import Model
from cadalign.estimation.options import LOSSES, FitOptions, pixel_information
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import Lenses, prior_of, rows_among, widened
from cadalign.estimation.problems import focal_slopes, rays_of, whitening_of
from cadalign.estimation.result_data import ResultData
from cadalign.estimation.result_parts import KeypointStatistics
from cadalign.estimation.symmetry import equal_slopes
from cadalign.estimation.uncertainty.derivatives import UNKNOWNS, Optima, lens_slopes
from cadalign.estimation.uncertainty.differences import JointOptimum
from cadalign.estimation.uncertainty.evidence import AnyBasis, Basis
from cadalign.estimation.uncertainty.residuals import whitening_matrices
from cadalign.estimation.view import View
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import points_of
from cadalign.solvers.joint.search import has_latent
from cadalign.solvers.unknowns import leaves_bounds

_SINGULAR = 1e-12
_NEAR = 1e-9  # of coordinates that are the same but for rounding


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of a result by its data, at the optimum.

    The u = 9 or 10 unknowns are those of `cadalign.Result.covariance`: the rotation vector in the
    frame of one view's camera [rad], the translation [model units], the logarithms of the object's
    lengths along x, y, z and, where it was estimated, of the focal length. Rows of what is held are
    0.
    """

    ids: tuple[Hashable, ...]
    """Ids or rows of the n keypoints of all views, one view after the other."""
    views: IntArray
    """Numbers of the views that they are in (n,)."""
    by_points_2d: FloatArray
    """Derivatives by the observed keypoints (u, n, 2) [per px]."""
    by_log_sigma: FloatArray
    """Derivatives by the logarithm of each keypoint's standard deviation (u, n)."""
    by_points_3d: FloatArray
    """Derivatives by the model's keypoints (u, n, 3) [per model unit]; of a learned shape, by its
    mean's. Rows of one keypoint in several views are equal: the model's moves in all."""
    points_by_points_2d: FloatArray | None
    """Derivatives of all keypoints of a shape that is not exact (m, 3, n, 2) [model units per
    px]."""
    points_by_log_sigma: FloatArray | None
    """The same by the logarithms of the standard deviations (m, 3, n)."""
    sigma: FloatArray
    """Standard deviations of the keypoints that the estimate took (n,) [px]."""
    covariance: FloatArray
    """`cadalign.Result.covariance` (u, u), in that view's frame."""

    @property
    def influence(self) -> FloatArray:
        """Influence (n,) of each keypoint on the whole result, in its standard deviations.

        The length of the result's change, whitened by its covariance, when the keypoint moves by
        its own standard deviation in the direction that moves the result most.
        """
        moves = np.moveaxis(self.by_points_2d, 1, 0) * self.sigma[:, None, None]
        information = np.linalg.pinv(self.covariance, rcond=_SINGULAR, hermitian=True)
        squares = moves.swapaxes(1, 2) @ information @ moves
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(squares)[:, -1], 0.0)))

    @property
    def rotation_deg(self) -> FloatArray:
        """Largest rotation (n,) by which a pixel of each keypoint turns the result [deg]."""
        turns = np.linalg.norm(np.moveaxis(self.by_points_2d[:3], 1, 0), ord=2, axis=(1, 2))
        return np.asarray(np.degrees(turns))

    @property
    def strongest(self) -> Hashable:
        """Id of the keypoint that moves the result most: that of the largest ``influence``.

        In several views, ``views`` at the same row is the number of its view.
        """
        return self.ids[int(np.argmax(self.influence))]

    def __str__(self) -> str:
        influence, turned = self.influence, self.rotation_deg
        lines = ["keypoint: change of the result per sigma [std], rotation per px [deg]"]
        several = self.views.max(initial=0) > 0
        lines.extend(
            f"  {f'views[{self.views[row]}] ' if several else ''}{self.ids[row]}: "
            f"{influence[row]:.2f}, {turned[row]:.2g}"
            for row in np.argsort(-influence, kind="stable")
        )
        return "\n".join(lines)


def sensitivity_of(result: ResultData, *, exact: bool, view: int) -> Sensitivity:
    """The sensitivity of a result; see `cadalign.Result.sensitivity`."""
    if not is_whole(view) or not 0 <= view < len(result.views):
        what = f"{quote(view)} is none of the result's {len(result.views)} views"
        raise InputError(what, where="view", fix=f"give 0 to {len(result.views) - 1}")
    statistics = result.statistics
    if isinstance(statistics, KeypointStatistics) and not result.camera.is_wide:
        if statistics.fisher_covariance is None:
            what = f"the method {result.method} minimises no cost, and has no derivatives"
            raise InputError(what, where="sensitivity", fix='fit with method="optimal"')
        return _of_keypoints(result, statistics, exact)
    if not exact:
        what = "only keypoints of one view of an exact model have a Gauss-Newton sensitivity"
        raise InputError(what, where="exact", fix="leave it at True")
    if not any(len(each.ids) for each in result.views):
        what = "an estimate without keypoints has no derivatives by them"
        raise InputError(what, where="sensitivity", fix="align with keypoints")
    basis = statistics.basis
    if basis is None and result.options is not None and result.covariance is not None:
        basis = _basis_of_fit(result, result.options)
    if basis is None:
        what = "the result holds no evidence: it was read from a file"
        raise InputError(what, where="sensitivity", fix="align again")
    return _of_evidence(result, basis, view)


def _basis_of_fit(result: ResultData, options: FitOptions) -> Basis:
    own = result.views[0]
    model = Model(
        points_3d=result.points_3d,
        ids=result.ids,
        stretch=options.stretch,
        stretch_sigma=options.stretch_sigma,
        known_axis=options.known_axis,
    )
    sigma = result.sigma if options.sigma is None else options.sigma
    camera = faced(own.camera, own.points_2d)
    view = View(camera, own.points_2d, ids=own.ids, sigma=sigma)
    group = 0 if options.focal == "estimate" else -1
    lenses = Lenses((camera,), (group,), options.focal_prior)
    evidence = evidence_of(prior_of(model), [view], options=options, lenses=lenses)
    rows = rows_among(result.ids, own.ids, "ids")
    evidence = with_sightings(evidence, own.inliers[np.argsort(rows, kind="stable")])
    pose = turned_alignment(own.alignment, camera.lens_from_camera.T)
    state = mean_state(evidence, pose.packed[None, :12], np.log(pose.scale))
    return Basis(evidence, state)


def _of_keypoints(result: ResultData, fitted: KeypointStatistics, exact: bool) -> Sensitivity:
    kept, view, options = fitted.inliers, result.views[0], fitted.options
    camera, alignment, n = view.camera, fitted.alignment, len(kept)
    pixels = np.require(view.points_2d[kept], requirements=["C", "W"])
    rays, sigma = rays_of(pixels, camera), fitted.chosen_sigma
    own = np.asarray(sigma, dtype=np.float64)[kept] if np.ndim(sigma) > 0 else sigma
    whitening = np.broadcast_to(whitening_of(own, rays, camera), (len(rays), 3))
    matrices = whitening_matrices(whitening)
    free, size, slopes, mean, weight = options.estimated_unknowns, UNKNOWNS - 1, None, 0.0, 0.0
    if options.focal == "estimate":
        size = UNKNOWNS
        low, high, mean, weight = log_focal_range(camera, options.focal_prior, camera.fx)
        if leaves_bounds(0.0, low, high, 0.0) or not low < 0.0 < high:
            free = free[free < UNKNOWNS - 1]
        if camera.distortion:
            slopes = focal_slopes(pixels, camera, rays)[None]
    optima = Optima(
        fitted.points_3d[kept][None],
        rays[None],
        (matrices.swapaxes(1, 2) @ matrices)[None],
        alignment.rotation[None],
        alignment.translation[None],
        alignment.scale[None],
        scale_prior=options.scale_prior,
        free=free,
        loss=LOSSES[options.loss],
        loss_scale=options.loss_scale,
        exact=exact,
        slopes=slopes,
        focal_offset=-mean,
        focal_weight=weight,
    )
    by_rays, by_log_sigma, by_place = optima.pull_back(np.eye(UNKNOWNS)[:size])
    by_pixels, by_sigma = np.zeros((size, n, 2)), np.zeros((size, n))
    by_points = np.zeros((size, n, 3))
    by_pixels[:, kept] = (by_rays[:, :, None] @ lens_slopes(rays, camera))[:, :, 0]
    by_sigma[:, kept], by_points[:, kept] = by_log_sigma, by_place
    variances = np.linalg.inv(pixel_information(sigma, n))
    return Sensitivity(
        tuple(view.ids),
        np.zeros(n, dtype=np.int64),
        by_pixels,
        by_sigma,
        by_points,
        None,
        None,
        np.asarray(np.sqrt(np.trace(variances, axis1=1, axis2=2) / 2)),
        cast(FloatArray, result.covariance),
    )


def _of_evidence(result: ResultData, basis: AnyBasis, view: int) -> Sensitivity:
    """The sensitivity of one view's pose, and of all that the views share."""
    numbers = basis.numbers or tuple(range(len(result.views)))
    if view not in numbers:
        what = f"views[{view}] is left out of the estimate"
        raise InputError(what, where="view", fix="give the number of another one")
    evidence, state = basis.evidence, basis.state
    if isinstance(basis, Basis) and isinstance(result.model, ShapeModel):  # as it was estimated
        evidence, state = widened(evidence, state, 1 / result.model.inflation)
    of_view = np.repeat(np.arange(len(result.views)), [len(each.ids) for each in result.views])
    ids = [name for each in result.views for name in each.ids]
    rows, kept = np.array(rows_among(result.ids, ids, "ids")), np.flatnonzero(result.inliers)
    kept = kept[np.argsort(rows[kept], kind="stable")]  # the order of the sightings
    pixels = np.concatenate(result.observed)[kept]
    cameras = [faced(each.camera, each.points_2d) for each in (result.views[k] for k in numbers)]
    optimum = JointOptimum.of(evidence, state, cameras, pixels)
    image, slopes = numbers.index(view), optimum.slopes
    points = _points_by_unknowns(result, optimum)
    turn = cameras[image].lens_from_camera
    shown, by_mean = _shown_by_unknowns(result, optimum, points, image, turn)

    def spread(values: FloatArray, axis: int) -> FloatArray:
        """Columns of all keypoints from those of the inliers, 0 for the others."""
        shape = list(values.shape)
        shape[axis] = len(ids)
        whole = np.zeros(shape)
        whole[(slice(None),) * axis + (kept,)] = values
        return whole

    def of_points(values: FloatArray) -> FloatArray | None:
        if not has_latent(evidence):
            return None
        return spread(np.tensordot(points[: len(result.points_3d)], values, 1), 2)

    by_points = np.tensordot(shown, slopes.by_points, 1)
    by_points[6:9] += by_mean[:, rows[kept]]
    sigma = np.sqrt(np.trace(optimum.keypoints.covariances, axis1=1, axis2=2) / 2)
    return Sensitivity(
        tuple(ids),
        of_view,
        spread(np.tensordot(shown, slopes.by_pixels, 1), 1),
        spread(np.tensordot(shown, slopes.by_log_sigma, 1), 1),
        spread(by_points, 1),
        of_points(slopes.by_pixels),
        of_points(slopes.by_log_sigma),
        spread(sigma, 0),
        cast(FloatArray, result.views[view].covariance),
    )


def _points_by_unknowns(result: ResultData, optimum: JointOptimum) -> FloatArray:
    """Derivatives (m + 2, 3, U) of points before the stretch, the box's corners last."""
    shape, (_, _, coefficients, displaced) = optimum.evidence.shape, optimum.parts
    count = len(shape.mean)
    found = np.zeros((count, 3, displaced + 3 * count))
    found[:, :, coefficients:displaced] = np.moveaxis(shape.modes, 0, 2)
    found[:, :, displaced:] = np.eye(3 * count).reshape(count, 3, -1)
    return found[np.r_[: len(result.ids), -2:0]]


def _shown_by_unknowns(
    result: ResultData, optimum: JointOptimum, points: FloatArray, image: int, turn: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (9 or 10, U) of rotation vector, translation, log lengths and log focal.

    ``turn`` (3, 3) leads from the frame of the view's camera, the one that was estimated in, to
    that of the result. Also returns the derivatives (3, m, 3) of the log lengths by the mean's
    keypoints that are corners.
    """
    evidence, (focals, scales, coefficients, _) = optimum.evidence, optimum.parts
    group, pose = int(evidence.focals.group[image]), 6 * int(evidence.rig.pose[image])
    found = np.zeros((9 + (group >= 0), points.shape[2]))
    whole = turn @ evidence.rig.cam_from_rig[image, :9].reshape(3, 3)
    found[:3, pose : pose + 3] = found[3:6, pose + 3 : pose + 6] = whole
    found[6:9, scales:coefficients] = np.eye(3)
    if group >= 0:
        found[9, focals + group] = 1.0
    if result.symmetry is not None:
        given = turned_alignment(poses_of(evidence, optimum.state)[image], turn)
        free = (evidence.scales.free == 0).tolist()
        found[:9] = equal_slopes(given, result.symmetry, held=tuple(free)) @ found[:9]
    by_mean = np.zeros((3, len(points), 3))
    if isinstance(result.model, ShapeModel):
        low, high = _corners(result, optimum)
        axes, extent = np.arange(3), result.bounds[1] - result.bounds[0]
        found[6:9] += (points[high, axes] - points[low, axes]) / extent[:, None]
        by_mean[axes, high, axes] += 1 / extent
        by_mean[axes, low, axes] -= 1 / extent
    return found, by_mean


def _corners(result: ResultData, optimum: JointOptimum) -> tuple[IntArray, IntArray]:
    """Rows (3,) of the shape's points that the least and the greatest corner move with.

    Without margins these are the corners of the linear box, or keypoints beyond them.
    """
    evidence, state, count = optimum.evidence, optimum.state, len(result.points_3d)
    seen = np.unique(evidence.sightings.point)
    seen = seen[seen < count]
    own = count + np.array([[0, 0, 0], [1, 1, 1]])
    if not len(evidence.offsets.value):
        linear = points_of(evidence.shape, state)[-2:] / np.exp(state.log_scales)
        points = np.concatenate([result.points_3d, linear])
        _, own = placed_box(points, count, seen, cast(ShapeModel, result.model))
    given = result.points_3d[seen]
    for side, outermost in enumerate((given.argmin(axis=0), given.argmax(axis=0))):
        at_corner = np.abs(result.bounds[side] - given[outermost, np.arange(3)]) < _NEAR
        own[side, at_corner] = seen[outermost[at_corner]]
    return own[0], own[1]
