"""The physical limit of accuracy: the Cramer-Rao bound of a problem with a known answer."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.evaluation.instances.symmetry import rotation_about
from cadalign.fitting.focal.grid import focal_slopes
from cadalign.fitting.noise import whitening_of
from cadalign.fitting.options import Sigma
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.constants import LINEAR, UNKNOWNS
from cadalign.solvers.focal import focal_covariance
from cadalign.solvers.objective import Objective
from cadalign.solvers.optimal import covariance_of

_LEAST_INFORMATION = 1e-12
_LARGEST_LOG = 50.0


def cramer_rao_bound(
    points_3d: FloatArray,
    camera: Camera,
    gt: Alignment,
    *,
    sigma: Sigma = 1.0,
    focal: str = "known",
) -> FloatArray:
    """The least covariance that any unbiased estimate of an alignment can have.

    The inverse of the Fisher information (J' W J)^-1 at the truth, for independent Gaussian noise
    of the keypoints.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points.
    camera : Camera
    gt : Alignment
        The truth, with the scale 1 along x.
    sigma : float, (n,) float or (n, 2, 2) float
        The keypoints' noise, as for `cadalign.fit` [px].
    focal : {"known", "estimate"}
        Whether the focal length is known to the estimator; the camera's is the truth.

    Returns
    -------
    (8, 8) or (9, 9) float
        Rotation vector in the camera frame [rad], translation [model units], log s_y and log s_z,
        and, where it is estimated, the logarithm of the focal length.

    Raises
    ------
    DegenerateError
        If the points do not determine the alignment.
    """
    in_camera = gt.apply(points_3d)
    rays = in_camera[:, :2] / in_camera[:, 2:]
    objective = Objective(
        np.require(points_3d, np.float64, ["C", "W"]),
        rays,
        whitening_of(sigma, rays, camera),
        LINEAR,
        1.0,
        0.0,
        np.ones(UNKNOWNS),
    )
    pose = np.concatenate([gt.rotation.ravel(), gt.translation, gt.scale])
    unknowns = UNKNOWNS + (focal == "estimate")
    covariance = np.zeros((unknowns, unknowns))
    if focal == "known":
        undetermined = covariance_of(objective, pose, covariance)
    else:
        slopes = focal_slopes(camera.project(in_camera), camera, rays)
        undetermined = focal_covariance(objective, slopes, 0.0, pose, covariance)
    if undetermined >= 0:
        raise DegenerateError("the points do not determine the alignment", where="points_3d")
    return covariance


def sample_limit(
    bound: FloatArray, gt: Alignment, *, rng: np.random.Generator, draws: int
) -> dict[str, FloatArray]:
    """Errors of an ideal estimator: draws from a Gaussian with the bound as its covariance.

    Returns
    -------
    dict
        ``rotation_error_deg``, ``translation_error``, ``scale_y_error``, ``scale_z_error``, each
        (draws,) float, in the units of `cadalign.metrics`; ``focal_error``, relative, if the
        focal length is unknown.
    """
    errors = rng.multivariate_normal(np.zeros(len(bound)), bound, size=draws, method="eigh")
    focal = {"focal_error": np.abs(np.expm1(errors[:, 8]))} if len(bound) > UNKNOWNS else {}
    return focal | {
        "rotation_error_deg": np.degrees(np.linalg.norm(errors[:, :3], axis=1)),
        "translation_error": np.linalg.norm(errors[:, 3:6], axis=1),
        "scale_y_error": np.abs(np.expm1(errors[:, 6])),
        "scale_z_error": np.abs(np.expm1(errors[:, 7])),
    }


def limit_estimate(
    points_3d: FloatArray,
    points_2d: FloatArray,
    camera: Camera,
    gt: Alignment,
    *,
    sigma: float = 1.0,
) -> Alignment:
    """What an ideal estimator would make of this very noise, to first order.

    The Gauss-Newton step from the truth, (J' J)^-1 J' e with the noise e of the observations. Over
    the noise its errors have exactly the Cramer-Rao bound as their covariance; that it takes the
    noise which the methods get keeps comparisons with them free of chance.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points.
    points_2d : (n, 2) float
        Their noisy observations [px].
    camera : Camera
        Without lens distortion.
    gt : Alignment
        The truth, with the scale 1 along x.
    sigma : float
        Standard deviation of the noise [px]; cancels out as long as it is the same for all.

    Returns
    -------
    Alignment
        exp(w) R, t + dt, s exp(ds): the truth, changed by the step.

    Raises
    ------
    DegenerateError
        If the points do not determine the alignment.
    """
    stretched = (points_3d * gt.scale) @ gt.rotation.T
    x, y, z = (stretched + gt.translation).T
    zero = np.zeros_like(z)
    # Derivatives of the pixels by the camera-frame point, (n, 2, 3).
    by_point = np.stack(
        [
            np.stack([camera.fx / z, zero, -camera.fx * x / z**2], axis=1),
            np.stack([zero, camera.fy / z, -camera.fy * y / z**2], axis=1),
        ],
        axis=1,
    )
    # Derivatives of that point by the unknowns, (n, 3, 8): w x X, dt, ds along the stretched axes.
    by_unknowns = np.zeros((len(points_3d), 3, UNKNOWNS))
    for k, axis in enumerate(np.eye(3)):
        by_unknowns[:, :, k] = np.cross(axis, stretched)
        by_unknowns[:, k, 3 + k] = 1.0
    for k in (1, 2):
        along = points_3d[:, k] * gt.scale[k]
        by_unknowns[:, :, 5 + k] = along[:, None] * gt.rotation[:, k]
    jacobian = (by_point @ by_unknowns).reshape(-1, UNKNOWNS) / sigma
    noise = (points_2d - camera.project(gt.apply(points_3d))).ravel() / sigma
    norms = np.linalg.norm(jacobian, axis=0)
    if len(noise) < UNKNOWNS or not (norms > 0).all():
        raise DegenerateError("the points do not determine the alignment", where="points_3d")
    scaled = jacobian / norms
    information = scaled.T @ scaled
    if np.linalg.eigvalsh(information)[0] < _LEAST_INFORMATION:
        raise DegenerateError("the points do not determine the alignment", where="points_3d")
    step = np.linalg.solve(information, scaled.T @ noise) / norms
    angle = float(np.linalg.norm(step[:3]))
    turn = rotation_about(step[:3] / angle, angle) if angle > 0 else np.eye(3)
    # The exponential of a weakly determined scale would overflow.
    factors = np.exp(np.clip(step[6:], -_LARGEST_LOG, _LARGEST_LOG))
    return Alignment(
        turn @ gt.rotation, gt.translation + step[3:6], gt.scale * np.append(1.0, factors)
    )
