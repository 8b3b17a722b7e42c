"""Derivatives of optima by the data, by the implicit function theorem, for many problems at once.

The optimum t of problem data d solves ``g(t, d) = 0``, g half the gradient of the cost. So
``dt/dd = -H^-1 dg/dd`` with ``H = dg/dt``, half the Hessian (Krantz, Parks, *The implicit function
theorem*, 2002; of PnP: Chen et al., *End-to-end learnable geometric vision by backpropagating PnP
optimization*, CVPR 2020). The unknowns t are those of `cadalign.Result.covariance`: rotation vector
in the camera frame, translation, logarithms of the scales, logarithm of the focal length.

The cost of a keypoint is ``rho(r' M r)``, with ``r = e^f pi(X) - y``, pi the projection of the
point in the camera ``X = R diag(s) x + t``, y the observed ray, M its information. About the point
p = (X, f), with P = dr/dp and a = M r,

    q = rho' P'a,    G = dq/dp = rho' P'M P + 2 rho'' (P'a)(P'a)' + rho' sum_k a_k d2 r_k / dp2,

and ``g = sum K'q``, ``H = sum K'G K + q . d2p/dt2`` with K = dp/dt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.uncertainty.residuals import loss_slopes
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import by_rotation
from cadalign.solvers.constants import LINEAR, ScalePrior

UNKNOWNS = 10
_FOCAL = 9
_LEAST_DEPTH = 1e-9  # of points behind the camera, which have no weight
_LEAST_SHARE = 1e-10  # of an unknown's information that the others must leave


@dataclass(frozen=True, eq=False)
class Optima:
    """Optima of B problems of at most n keypoints; those that are absent have the information 0.

    With ``exact``, H is the Hessian, otherwise the Gauss-Newton matrix, which leaves out what
    vanishes with the residuals.
    """

    points: FloatArray  # (B, n, 3) of the model
    rays: FloatArray  # (B, n, 2) observed
    information: FloatArray  # (B, n, 2, 2) of the rays
    rotation: FloatArray  # (B, 3, 3)
    translation: FloatArray  # (B, 3)
    scale: FloatArray  # (B, 3)
    scale_prior: ScalePrior
    free: IntArray  # (u,) rows of the unknowns that were estimated
    loss: int  # one of `cadalign.solvers.constants`
    loss_scale: float
    exact: bool
    focal_offset: FloatArray  # (B,) of the log focal length from its prior's mean
    focal_weight: FloatArray  # (B,) of that prior

    @cached_property
    def _axes(self) -> FloatArray:
        """Stretched axes of the model in the camera (B, 1, 3, 3), one a column."""
        return np.asarray((self.rotation * self.scale[:, None, :])[:, None])

    @cached_property
    def _along(self) -> FloatArray:
        """Parts of the turned points (B, n, 3, 3) that are due to x, y, z, one a column."""
        return np.asarray(self._axes * self.points[:, :, None, :])

    @cached_property
    def _turned(self) -> FloatArray:
        return np.asarray(self._along.sum(axis=3))

    @cached_property
    def _projection(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Projected rays (B, n, 2), inverse depths (B, n), and dr/dp (B, n, 2, 4)."""
        in_camera = self._turned + self.translation[:, None]
        inverse = 1.0 / np.maximum(in_camera[..., 2], _LEAST_DEPTH)
        projected = in_camera[..., :2] * inverse[..., None]
        slope = np.zeros((*inverse.shape, 2, 4))
        slope[..., 0, 0] = slope[..., 1, 1] = inverse
        slope[..., 2] = -projected * inverse[..., None]
        slope[..., 3] = projected
        return projected, inverse, slope

    @cached_property
    def _weighted(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Forces a = M r (B, n, 2), squares r'M r, and the loss's first and second derivative."""
        residuals = self._projection[0] - self.rays
        force = (self.information @ residuals[..., None])[..., 0]
        squares = (force * residuals).sum(axis=-1)
        first, second = loss_slopes(squares, self.loss, self.loss_scale)
        return force, squares, first, second if self.exact else np.zeros_like(second)

    @cached_property
    def _by_unknowns(self) -> FloatArray:
        """K = dp/dt (B, n, 4, 10)."""
        rows = np.zeros((*self._turned.shape[:2], 4, UNKNOWNS))
        rows[..., :3, :3] = by_rotation(self._turned)
        rows[..., 0, 3] = rows[..., 1, 4] = rows[..., 2, 5] = rows[..., 3, _FOCAL] = 1.0
        rows[..., :3, 6:9] = self._along
        return rows

    @cached_property
    def _forces(self) -> FloatArray:
        """Half the derivatives q (B, n, 4) of the cost by the points p."""
        force, _, first, _ = self._weighted
        by_point = self._projection[2]
        return np.asarray(first[..., None] * (force[..., None, :] @ by_point)[..., 0, :])

    @cached_property
    def _curvature(self) -> FloatArray:
        """G (B, n, 4, 4)."""
        force, _, first, second = self._weighted
        projected, inverse, by_point = self._projection
        whitened = first[..., None, None] * self.information
        if self.exact and self.loss != LINEAR:
            bending = force[..., :, None] * force[..., None, :]
            whitened = whitened + 2.0 * second[..., None, None] * bending
        curvature = by_point.swapaxes(-1, -2) @ (whitened @ by_point)
        if not self.exact:
            return np.asarray(curvature)
        weighted = first[..., None] * force
        across = weighted * (inverse**2)[..., None]
        along = (weighted * projected).sum(axis=-1)
        curvature[..., :2, 2] -= across
        curvature[..., 2, :2] -= across
        curvature[..., 2, 2] += 2.0 * along * inverse**2
        by_focal = (weighted[..., None, :] @ by_point[..., :3])[..., 0, :]
        curvature[..., 3, :3] += by_focal
        curvature[..., :3, 3] += by_focal
        curvature[..., 3, 3] += along
        return np.asarray(curvature)

    @cached_property
    def gradient(self) -> FloatArray:
        """Half the gradient of the cost (B, u), of the free unknowns; 0 at an optimum."""
        count, n = self._turned.shape[:2]
        rows = self._by_unknowns.reshape(count, 4 * n, UNKNOWNS)
        whole = (self._forces.reshape(count, 1, 4 * n) @ rows)[:, 0]
        logs, width = np.log(self.scale), self.scale_prior.width
        whole[:, 6:9] += self.scale_prior.weight * (logs - np.clip(logs, -width, width))
        whole[:, _FOCAL] += self.focal_weight * self.focal_offset
        return np.asarray(whole[:, self.free])

    @cached_property
    def hessian(self) -> FloatArray:
        """H (B, u, u) of the free unknowns."""
        count, n = self._turned.shape[:2]
        rows = self._by_unknowns
        curved = (self._curvature @ rows).reshape(count, 4 * n, UNKNOWNS)
        whole = rows.reshape(count, 4 * n, UNKNOWNS).swapaxes(1, 2) @ curved
        if self.exact:
            self._add_motion(whole)
        axes, is_bound = np.arange(6, 9), np.abs(np.log(self.scale)) >= self.scale_prior.width
        whole[:, axes, axes] += self.scale_prior.weight * is_bound
        whole[:, _FOCAL, _FOCAL] += self.focal_weight
        return np.asarray(whole[:, self.free[:, None], self.free])

    def _add_motion(self, whole: FloatArray) -> None:
        """Add q . d2p/dt2: of two turns a and b it is the mean of q_a X_b and q_b X_a, less q . X.

        A turn about axis a and a longer axis k give ``(Y_k x q)_a``, Y_k the part of X due to k.
        """
        forces = self._forces[..., :3]
        moments = forces.swapaxes(1, 2) @ self._turned
        turns = (moments + moments.swapaxes(1, 2)) / 2
        diagonal = np.arange(3)
        turns[:, diagonal, diagonal] -= np.trace(moments, axis1=1, axis2=2)[:, None]
        whole[:, :3, :3] += turns
        by_axis = (forces[..., None] * self.points[:, :, None, :]).sum(axis=1)
        axes = self._axes[:, 0]
        mixed = np.cross(axes, by_axis, axis=1)
        whole[:, :3, 6:9] += mixed
        whole[:, 6:9, :3] += mixed.swapaxes(1, 2)
        whole[:, diagonal + 6, diagonal + 6] += (axes * by_axis).sum(axis=1)

    @cached_property
    def solved(self) -> tuple[FloatArray, BoolArray]:
        """Inverse of H (B, u, u), and whether the data determine all unknowns (B,).

        The inverse is 0 where they do not, H being nearly singular or not positive.
        """
        diagonal = np.diagonal(self.hessian, axis1=1, axis2=2)
        is_finite = np.isfinite(self.hessian).all(axis=(1, 2))
        usable = np.asarray((diagonal > 0).all(axis=1) & is_finite)
        root = np.sqrt(np.where(usable[:, None], diagonal, 1.0))
        scaled = self.hessian / (root[:, :, None] * root[:, None, :])
        scaled = np.where(usable[:, None, None], scaled, np.eye(len(self.free)))
        try:
            inverse = np.asarray(np.linalg.inv(scaled), dtype=np.float64)
        except np.linalg.LinAlgError:  # one of them is singular to the last digit
            scaled = scaled + 1e-13 * np.eye(len(self.free))
            inverse = np.asarray(np.linalg.inv(scaled), dtype=np.float64)
        shares = np.diagonal(inverse, axis1=1, axis2=2)
        determined = usable & ((shares > 0) & (shares < 1 / _LEAST_SHARE)).all(axis=1)
        inverse /= root[:, :, None] * root[:, None, :]
        inverse[~determined] = 0.0
        return inverse, determined

    @cached_property
    def newton_step(self) -> FloatArray:
        """Step (B, 10) of all unknowns to the optimum; 0 where it is not determined."""
        step = np.zeros((len(self.scale), UNKNOWNS))
        step[:, self.free] = -(self.solved[0] @ self.gradient[..., None])[..., 0]
        return step

    def pull_back(self, slopes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives by the data of numbers whose derivatives by the unknowns are (B, 10).

        By rays (B, n, 2), log sigmas (B, n) and points (B, n, 3).
        """
        adjoint = np.zeros((len(slopes), UNKNOWNS))
        adjoint[:, self.free] = -(self.solved[0] @ slopes[:, self.free, None])[..., 0]
        force, squares, first, second = self._weighted
        moved = (self._by_unknowns @ adjoint[:, None, :, None])[..., 0]  # (B, n, 4)
        seen = (self._projection[2] @ moved[..., None])[..., 0]
        agreement = (force * seen).sum(axis=-1)
        by_rays = -first[..., None] * (self.information @ seen[..., None])[..., 0]
        by_rays -= 2.0 * (second * agreement)[..., None] * force
        by_log_sigma = -2.0 * (first + second * squares) * agreement
        by_place = (self._curvature @ moved[..., None])[..., :3, 0]
        by_points = (by_place[..., None, :] @ self._axes)[..., 0, :]
        if self.exact:
            axes = self._axes[:, 0].swapaxes(1, 2)
            turned = np.cross(adjoint[:, None, :3], axes) + adjoint[:, 6:9, None] * axes
            by_points = by_points + self._forces[..., :3] @ turned.swapaxes(1, 2)
        return by_rays, by_log_sigma, by_points


def lens_slopes(rays: FloatArray, camera: Camera) -> FloatArray:
    """Derivatives (n, 2, 2) of undistorted rays (n, 2) by the pixels."""
    inverse = np.diag([1.0 / camera.fx, 1.0 / camera.fy])
    if not camera.distortion:
        return np.broadcast_to(inverse, (len(rays), 2, 2))
    return np.asarray(np.linalg.inv(camera.distortion_jacobian(rays)) @ inverse)
