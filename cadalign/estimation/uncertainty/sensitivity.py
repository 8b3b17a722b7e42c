"""Sensitivity of a result: its derivatives by keypoints, their sigmas and the model's points."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.focal import log_focal_range
from cadalign.estimation.options import LOSSES, pixel_information
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
from cadalign.solvers.unknowns import leaves_bounds

_SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of a result by its data, at the optimum.

    The u = 9 or 10 unknowns are those of `cadalign.Result.covariance`: the rotation vector in the
    frame of one view's camera [rad], the translation [model units], the logarithms of the object's
    lengths along x, y, z and, where it was estimated, of the focal length. Rows of what is held are
    0.

    Parameters
    ----------
    ids : tuple of int or str
        Ids or rows of the n keypoints of all views, one view after the other.
    views : (n,) int
        Numbers of the views that they are in.
    by_points_2d : (u, n, 2) float
        Derivatives by the observed keypoints [per px].
    by_log_sigma : (u, n) float
        Derivatives by the logarithm of each keypoint's standard deviation.
    by_points_3d : (u, n, 3) float
        Derivatives by the model's keypoints [per model unit]; of a learned shape, by its mean's.
        Rows of one keypoint in several views are equal: the model's moves in all.
    points_by_points_2d : (m, 3, n, 2) float, optional
        Derivatives of all keypoints of a shape that is not exact [model units per px].
    points_by_log_sigma : (m, 3, n) float, optional
        The same by the logarithms of the standard deviations.
    sigma : (n,) float
        Standard deviations of the keypoints that the estimate took [px].
    covariance : (u, u) float
        `cadalign.Result.covariance`, in that view's frame.
    """

    ids: tuple[Hashable, ...]
    views: IntArray
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
        """Id of the keypoint that moves the result most: that of the largest ``influence``.

        In several views, ``views`` at the same row tells which one it is in.
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


def sensitivity_of_keypoints(
    result: ResultData, fitted: KeypointStatistics, *, exact: bool
) -> Sensitivity:
    """The sensitivity of a fit, in closed form."""
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
        np.zeros(n, dtype=np.int64),
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
