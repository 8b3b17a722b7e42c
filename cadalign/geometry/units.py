"""Units of a model's keypoints and of its mesh, compared: both are in the model's coordinates."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError

_MARGIN = 0.3  # by which keypoints may lie outside of the mesh's box [its diagonals]
_FAR = 1.0  # from which on they are another model's
_LEAST_SHARE = 0.3  # of the mesh's diagonal that keypoints span once they are in its unit
_SMALL = 0.05  # share from which down they may be in a larger unit
_UNITS = {
    1000.0: "in millimetres beside a mesh in metres",
    100.0: "in centimetres beside a mesh in metres",
    25.4: "in millimetres beside a mesh in inches",
    10.0: "in millimetres beside a mesh in centimetres",
    0.01: "in metres beside a mesh in centimetres",
    0.001: "in metres beside a mesh in millimetres",
}
"""By how many times larger keypoints are than the mesh: the likely units."""


def check_near(points_3d: FloatArray, bounds: FloatArray, *, where: str) -> None:
    """Refuse keypoints (k, 3) that lie far from their mesh, with the factor if it is a unit's.

    Parameters
    ----------
    points_3d : (k, 3) float
        Keypoints of the model [model units].
    bounds : (2, 3) float
        Least and greatest coordinates of its mesh [model units].
    where : str
        Name of the keypoints, for the message.

    Raises
    ------
    InputError
        If the keypoints fit the mesh in another unit only, or one lies more than a diagonal from
        the mesh's box.

    Examples
    --------
    >>> corners = np.array([[x, y, z] for x in (0, 800) for y in (0, 900) for z in (0, 500.0)])
    >>> check_near(corners, np.array([[0, 0, 0], [0.8, 0.9, 0.5]]), where="points_3d")
    Traceback (most recent call last):
    cadalign.errors.InputError: points_3d: the keypoints span 1.31e+03 model units, the mesh 1.31...
    """
    diagonal = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not len(points_3d) or not diagonal > 0:
        return
    span = float(np.linalg.norm(np.ptp(points_3d, axis=0)))
    outside = _outside(points_3d, bounds)
    if outside.max() > _MARGIN * diagonal or span < _SMALL * diagonal:
        fitting = [
            factor
            for factor in _UNITS
            if span >= _LEAST_SHARE * factor * diagonal
            and _outside(points_3d / factor, bounds).max() <= _MARGIN * diagonal
        ]
        if fitting and span > 0:
            factor = min(fitting, key=lambda each: abs(np.log(span / (each * diagonal))))
            raise InputError(
                f"the keypoints span {span:.3g} model units, the mesh {diagonal:.3g}: they fit it "
                f"divided by {factor:g}, as keypoints {_UNITS[factor]}",
                where=where,
                fix=f"give both in one unit: multiply the keypoints by {1 / factor:g}",
            )
    if outside.max() > _FAR * diagonal:
        row = int(outside.argmax())
        what = f"keypoint {row} lies {outside[row] / diagonal:.3g} diagonals of the mesh from it"
        fix = "give the keypoints and the mesh of one model, in the same coordinates"
        raise InputError(what, where=where, fix=fix)


def _outside(points: FloatArray, bounds: FloatArray) -> FloatArray:
    """Distances (k,) of points (k, 3) from a box, 0 inside."""
    beyond = np.maximum(bounds[0] - points, points - bounds[1]).clip(0)
    return np.asarray(np.linalg.norm(beyond, axis=1))
