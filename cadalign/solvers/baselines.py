"""Baselines: the solver of the AEPnP paper as published, and OpenCV's EPnP without stretch."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.geometry.alignment import describe_plane
from cadalign.solvers.linear import MIN_POINTS, SPAN_FIX, aepnp_error, out_of_range_error

_EPNP_POINTS = 4


@np.errstate(all="ignore")
def aepnp_paper(
    points_3d: npt.ArrayLike, rays: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve anisotropic PnP with the linear null-space solver of the AEPnP paper.

    Wei, Leutenegger, Kneip, "AEPnP: A Less-constrained EPnP Solver for Pose Estimation with
    Anisotropic Scaling". The four control points are the origin and the ends of the unit axes. A
    point has the weights (x, y, z, 1 - x - y - z) on them, with or without stretch. Every point
    gives two linear equations in the 12 camera-frame coordinates of the control points. Their null
    vector holds the stretched axes up to a common factor. Each axis is normalised separately, so
    noise makes them not quite orthogonal; the nearest rotation is returned.

    Parameters
    ----------
    points_3d, rays
        As for `cadalign.solvers.aepnp`, but rays only as (n, 2).

    Returns
    -------
    rotation, translation, scale
        As from `cadalign.solvers.aepnp`.

    Raises
    ------
    DegenerateError
        If there are fewer than 6 points, they lie in one plane, an axis of the solution has zero
        length, or numbers overflow.
    """
    points = np.asarray(points_3d, dtype=float)
    count = len(points)
    if count < MIN_POINTS or describe_plane(points) is not None:
        raise aepnp_error(points)
    u, v = np.asarray(rays, dtype=float).T
    weights = np.column_stack([points, 1 - points.sum(axis=1)])
    system = np.zeros((2 * count, 4, 3))
    system[0::2, :, 0] = weights
    system[0::2, :, 2] = -u[:, None] * weights
    system[1::2, :, 1] = weights
    system[1::2, :, 2] = -v[:, None] * weights
    matrix = system.reshape(2 * count, 12)
    squares = matrix.T @ matrix
    size = np.abs(squares).max()
    if not np.isfinite(size):
        raise out_of_range_error()
    # Normalise: LAPACK does not converge where the squares of the entries overflow.
    _, vectors = np.linalg.eigh(squares / size)
    control_points = vectors[:, 0].reshape(4, 3)
    if (weights @ control_points[:, 2]).sum() < 0:
        control_points = -control_points
    origin = control_points[3]
    axes = (control_points[:3] - origin).T
    lengths = np.linalg.norm(axes, axis=0)
    if not (lengths > 1e-12 * np.abs(control_points).max()).all():
        what = "an axis of the solution has zero length"
        raise DegenerateError(what, where="points_3d", fix=SPAN_FIX)
    left, _, right = np.linalg.svd(axes / lengths)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation, origin / lengths[0], lengths / lengths[0]


def epnp(
    points_3d: npt.ArrayLike, rays: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve plain PnP with ``cv2.solvePnP(..., flags=cv2.SOLVEPNP_EPNP)``.

    Lepetit, Moreno-Noguer, Fua, "EPnP: An Accurate O(n) Solution to the PnP Problem", 2009.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points, at least 4.
    rays : (n, 2) float
        Normalised image coordinates.

    Returns
    -------
    rotation : (3, 3) float
    translation : (3,) float
    scale : (3,) float
        Always (1, 1, 1).

    Raises
    ------
    DegenerateError
        If there are fewer than 4 points or OpenCV finds no pose.
    """
    import cv2  # slow to import

    points = np.ascontiguousarray(points_3d, dtype=float)
    if len(points) < _EPNP_POINTS:
        raise DegenerateError(
            f"{len(points)} points are too few for EPnP",
            where="points_3d",
            fix=f"give at least {_EPNP_POINTS}",
        )
    try:
        found, rotation_vector, translation = cv2.solvePnP(
            points,
            np.ascontiguousarray(rays, dtype=float),
            np.eye(3),
            None,
            flags=cv2.SOLVEPNP_EPNP,
        )
    except cv2.error as error:
        raise DegenerateError(f"OpenCV rejected the points ({error})", where="epnp") from None
    if not found or not (np.isfinite(rotation_vector).all() and np.isfinite(translation).all()):
        raise DegenerateError("OpenCV found no pose", where="epnp")
    rotation, _ = cv2.Rodrigues(rotation_vector)
    return np.asarray(rotation, dtype=float), np.asarray(translation[:, 0], dtype=float), np.ones(3)
