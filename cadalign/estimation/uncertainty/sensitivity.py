"""Sensitivity of a result: its derivatives by keypoints, their sigmas and the model's points."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.estimates import placed_box
from cadalign.estimation.focal import log_focal_range
from cadalign.estimation.options import LOSSES, pixel_information
from cadalign.estimation.pack import SingleBasis, seen_keypoints
from cadalign.estimation.prior import prior_of
from cadalign.estimation.problems import focal_slopes, rays_of, whitening_of
from cadalign.estimation.result_data import ResultData
from cadalign.estimation.uncertainty.derivatives import (
    UNKNOWNS,
    Optima,
    PriorTerms,
    SeenKeypoints,
)
from cadalign.estimation.uncertainty.stated import KeypointStatistics
from cadalign.geometry.camera import Camera
from cadalign.shapes.box_margins import BoxMargins
from cadalign.solvers.marginal.problem import Mixture
from cadalign.solvers.marginal.slopes import slopes_of
from cadalign.solvers.unknowns import leaves_bounds

_SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of a result by its data, at the optimum.

    The u = 9 or 10 unknowns are those of `cadalign.Result.covariance`: the rotation vector in the
    camera's frame [rad], the translation [model units], the logarithms of the object's lengths
    along x, y, z and, where it was estimated, of the focal length. Rows of what is held are 0.

    Parameters
    ----------
    ids : tuple of int or str
        Ids or rows of the n keypoints of the view.
    by_points_2d : (u, n, 2) float
        Derivatives by the observed keypoints [per px].
    by_log_sigma : (u, n) float
        Derivatives by the logarithm of each keypoint's standard deviation.
    by_points_3d : (u, n, 3) float
        Derivatives by the model's keypoints [per model unit]; of a learned shape, by its mean's.
    points_by_points_2d : (m, 3, n, 2) float, optional
        Derivatives of all keypoints of a learned shape [model units per px].
    points_by_log_sigma : (m, 3, n) float, optional
        The same by the logarithms of the standard deviations.
    sigma : (n,) float
        Standard deviations of the keypoints that the estimate took [px].
    covariance : (u, u) float
        `cadalign.Result.covariance`.
    """

    ids: tuple[Hashable, ...]
    by_points_2d: FloatArray
    by_log_sigma: FloatArray
    by_points_3d: FloatArray
    points_by_points_2d: FloatArray | None
    points_by_log_sigma: FloatArray | None
    sigma: FloatArray
    covariance: FloatArray

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
        """Id of the keypoint that moves the result most: that of the largest ``influence``."""
        return self.ids[int(np.argmax(self.influence))]

    def __str__(self) -> str:
        influence, turned = self.influence, self.rotation_deg
        lines = ["keypoint: change of the result per sigma [std], rotation per px [deg]"]
        lines.extend(
            f"  {self.ids[row]}: {influence[row]:.2f}, {turned[row]:.2g}"
            for row in np.argsort(-influence, kind="stable")
        )
        return "\n".join(lines)


def sensitivity_of(result: ResultData, *, exact: bool) -> Sensitivity:
    """The sensitivity of a result; see `cadalign.Result.sensitivity`."""
    statistics = result.statistics
    if len(result.views) == 1 and not result.camera.is_wide and result.principal_std is None:
        if isinstance(statistics, KeypointStatistics) and result.options is not None:
            if statistics.fisher_covariance is not None:
                return _of_keypoints(result, statistics, exact)
        elif isinstance(statistics.basis, SingleBasis) and exact:
            return _of_shape(result, statistics.basis)
    if isinstance(statistics.basis, SingleBasis) and not exact:
        raise InputError(
            "a learned shape has no Gauss-Newton sensitivity",
            where="exact",
            fix="leave it at True",
        )
    raise InputError(
        "only keypoints of one view, of an exact, stretched or learned model, aligned by maximum "
        "likelihood without a wide lens or unknown principal point, have a sensitivity",
        where="sensitivity",
        fix="align these alone, in this program: files do not hold the evidence",
    )


def _of_keypoints(result: ResultData, fitted: KeypointStatistics, exact: bool) -> Sensitivity:
    kept, view, options = result.inliers, result.views[0], fitted.options
    pixels = np.require(view.points_2d[kept], requirements=["C", "W"])
    optima = _optimum(fitted, pixels, exact)
    size = 10 if options.focal == "estimate" else 9
    pulled = optima.pull_back(np.eye(UNKNOWNS)[:size])
    n = len(kept)
    by_pixels, by_sigma = np.zeros((size, n, 2)), np.zeros((size, n))
    by_points = np.zeros((size, n, 3))
    lens = lens_slopes(optima.keypoints.rays[0], view.camera)
    by_pixels[:, kept] = (pulled.by_rays[:, :, None] @ lens)[:, :, 0]
    by_sigma[:, kept], by_points[:, kept] = pulled.by_log_sigma, pulled.by_points
    return Sensitivity(
        tuple(view.ids),
        by_pixels,
        by_sigma,
        by_points,
        None,
        None,
        _sigmas(fitted.chosen_sigma, n),
        cast(FloatArray, result.covariance),
    )


def _optimum(fitted: KeypointStatistics, pixels: FloatArray, exact: bool) -> Optima:
    """The optimum of one fit to its inliers' ``pixels`` (k, 2)."""
    options, camera = fitted.options, fitted.camera
    rays = rays_of(pixels, camera)
    sigma = fitted.chosen_sigma
    if np.ndim(sigma) > 0:
        sigma = np.asarray(sigma, dtype=np.float64)[fitted.inliers]
    whitening = np.broadcast_to(whitening_of(sigma, rays, camera), (len(rays), 3))
    estimates_focal = options.focal == "estimate"
    prior, free = PriorTerms(options.scale_prior), options.estimated_unknowns
    slopes = None
    if estimates_focal:
        low, high, mean, weight = log_focal_range(camera, options.focal_prior, camera.fx)
        if leaves_bounds(0.0, low, high, 0.0) or not low < 0.0 < high:
            free = free[free < UNKNOWNS - 1]
        prior = PriorTerms(options.scale_prior, -mean, weight)
        if camera.distortion:
            slopes = focal_slopes(pixels, camera, rays)[None]
    keypoints = SeenKeypoints(
        fitted.points_3d[fitted.inliers][None],
        rays[None],
        information_of(whitening)[None],
        LOSSES[options.loss],
        options.loss_scale,
        slopes,
    )
    alignment = fitted.alignment
    return Optima(
        keypoints,
        alignment.rotation[None],
        alignment.translation[None],
        alignment.scale[None],
        prior,
        free,
        exact,
    )


def information_of(whitening: FloatArray) -> FloatArray:
    """Information (..., 2, 2) of rays from rows (..., 3) of weights; see `whitening_of`."""
    a, b, c = np.moveaxis(whitening, -1, 0)
    rows = np.stack([a * a, a * b, a * b, b * b + c * c], axis=-1)
    return np.asarray(rows.reshape(*rows.shape[:-1], 2, 2))


def lens_slopes(rays: FloatArray, camera: Camera) -> FloatArray:
    """Derivatives (n, 2, 2) of undistorted rays (n, 2) by the pixels."""
    inverse = np.diag([1.0 / camera.fx, 1.0 / camera.fy])
    if not camera.distortion:
        return np.broadcast_to(inverse, (len(rays), 2, 2))
    return np.asarray(np.linalg.inv(camera.distortion_jacobian(rays)) @ inverse)


def _sigmas(sigma: object, count: int) -> FloatArray:
    """Standard deviations (n,) [px] of keypoints, root mean square over x and y."""
    variances = np.linalg.inv(pixel_information(sigma, count))
    return np.asarray(np.sqrt(np.trace(variances, axis1=1, axis2=2) / 2))


def _of_shape(result: ResultData, basis: SingleBasis) -> Sensitivity:
    """The sensitivity of a learned shape: of the pose and the forces, and all that follows."""
    view, options = basis.view, basis.options
    rows = np.array(prior_of(basis.model).rows_of(view.keypoint_ids, "views[0].ids"))
    means, covariances, weights = basis.model.gaussians
    mixture = Mixture(means, covariances, -2 * np.log(weights))
    seen = seen_keypoints(view, cast(FloatArray, view.points_2d), rows.tolist(), options)
    slopes = slopes_of(mixture, basis.component, seen, basis.pose, basis.force, True)
    moved = -np.linalg.solve(slopes.by_state, slopes.by_data)
    beside = (3 * rows[:, None] + np.arange(3)).ravel()
    whole = covariances[basis.component]
    n, lens = len(rows), lens_slopes(seen.rays, view.camera)
    points: FloatArray = (whole[:, beside] @ moved[6:]).reshape(len(means[0]), 3, 6 * n)

    def by_pixels(by_rays: FloatArray) -> FloatArray:
        by_ray = by_rays.reshape(*by_rays.shape[:-1], n, 1, 2)
        return np.asarray((by_ray @ lens)[..., 0, :])

    shape = result.points_3d
    extent = np.asarray(result.bounds[1] - result.bounds[0])
    unknowns = np.zeros((9, 6 * n))
    unknowns[:6] = moved[:6]
    linear = means[basis.component][-2:] + (whole[-6:, beside] @ basis.force.ravel()).reshape(2, 3)
    low, high = _corner_rows(result, basis.model.box_margins, linear, rows)
    axes = np.arange(3)
    unknowns[6:9] = (points[high, axes] - points[low, axes]) / extent[:, None]
    by_mean = unknowns[:, 3 * n :].reshape(9, n, 3)
    return Sensitivity(
        tuple(view.keypoint_ids),
        by_pixels(unknowns[:, : 2 * n]),
        unknowns[:, 2 * n : 3 * n],
        by_mean,
        by_pixels(points[: len(shape), :, : 2 * n]),
        points[: len(shape), :, 2 * n : 3 * n],
        _sigmas(view.sigma, n),
        cast(FloatArray, result.covariance),
    )


def _corner_rows(
    result: ResultData, margins: BoxMargins | None, linear: FloatArray, seen: IntArray
) -> tuple[IntArray, IntArray]:
    """Rows (3,) of the shape's points that the least and the greatest corner move with.

    Without margins these are the corners of the ``linear`` box (2, 3), or keypoints beyond them.
    """
    count = len(result.points_3d)
    own = count + np.array([[0, 0, 0], [1, 1, 1]])
    if margins is not None:
        _, own = placed_box(np.concatenate([result.points_3d, linear]), seen, margins)
    given = result.points_3d[seen]
    for side, outermost in enumerate((given.argmin(axis=0), given.argmax(axis=0))):
        is_there = result.bounds[side] == given[outermost, np.arange(3)]
        own[side, is_there] = seen[outermost[is_there]]
    return own[0], own[1]
