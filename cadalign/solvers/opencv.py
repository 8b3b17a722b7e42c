"""OpenCV's EPnP, which takes the model as it is: the baseline that knows no stretch."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError

MIN_POINTS = 4


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
    points = np.ascontiguousarray(points_3d, dtype=float)
    if len(points) < MIN_POINTS:
        raise DegenerateError(
            f"{len(points)} points are too few for EPnP",
            where="points_3d",
            fix=f"give at least {MIN_POINTS}",
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
        raise DegenerateError(f"OpenCV refused the points ({error})", where="epnp") from None
    if not found or not (np.isfinite(rotation_vector).all() and np.isfinite(translation).all()):
        raise DegenerateError("OpenCV found no pose", where="epnp")
    rotation, _ = cv2.Rodrigues(rotation_vector)
    return np.asarray(rotation, dtype=float), np.asarray(translation[:, 0], dtype=float), np.ones(3)
