"""Next-best keypoint: the candidate whose measurement reduces the uncertainty most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.fitting.prediction import predicted_covariances, projection_jacobian
from cadalign.fitting.uncertainty import unknown_axes
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera


@dataclass(frozen=True)
class NextBest:
    """The candidate to measure next, and its effect.

    Parameters
    ----------
    row : int
        Row of the candidate.
    unknown : int
        Index of the most uncertain unknown in `FitResult.covariance`.
    before, after : float
        Standard deviation of that unknown without and with the measurement: radians, shares of the
        distance, or relative (0.02 is 2 %).
    """

    row: int
    unknown: int
    before: float
    after: float


def find_next_best(
    points_3d: FloatArray,
    camera: Camera,
    alignment: Alignment,
    covariance: FloatArray,
    *,
    sigma: float,
    known_axis: str = "x",
) -> NextBest | None:
    """Choose the keypoint whose measurement shrinks the most uncertain unknown most.

    Measuring a keypoint with the derivatives J turns the covariance C into
    C - C J' (J C J' + sigma^2)^-1 J C. To be comparable, rotations count in radians, translations
    as shares of the distance, scales and focal length by their logarithms.

    Parameters
    ----------
    points_3d : (n, 3) float
        Candidates, all visible [model units].
    camera : Camera
    alignment : Alignment
    covariance : (8, 8) or (9, 9) float
        As of `FitResult`.
    sigma : float
        Standard deviation of the measurement [px].
    known_axis : {"x", "y", "z"}

    Returns
    -------
    NextBest or None
        Of equally good candidates the first; None if there are none, or nothing is uncertain.
    """
    weights = _comparable(alignment, len(covariance))
    spread = np.sqrt(np.maximum(covariance.diagonal(), 0.0)) * weights
    worst = int(np.argmax(spread))
    if not len(points_3d) or not spread[worst] > 0:
        return None
    variances = updated_variances(
        points_3d, camera, alignment, covariance, sigma=sigma, known_axis=known_axis
    )[:, worst]
    # Rounded, so that candidates that are equal but for rounding are told apart by their order.
    row = int(np.argmin(np.round(variances / covariance[worst, worst], 9)))
    after = float(np.sqrt(max(variances[row], 0.0)) * weights[worst])
    return NextBest(row, worst, float(spread[worst]), after)


def updated_variances(
    points_3d: FloatArray,
    camera: Camera,
    alignment: Alignment,
    covariance: FloatArray,
    *,
    sigma: float,
    known_axis: str = "x",
) -> FloatArray:
    """The unknowns' variances (n, k) if one of n candidates is measured; see `find_next_best`."""
    jacobian = projection_jacobian(
        points_3d, camera, alignment, known_axis=known_axis, unknowns=len(covariance)
    )
    innovation = predicted_covariances(jacobian, covariance) + sigma**2 * np.eye(2)
    gain = covariance @ jacobian.transpose(0, 2, 1)
    shrunk = np.einsum("nka,nab,nkb->nk", gain, np.linalg.inv(innovation), gain)
    return np.asarray(covariance.diagonal() - shrunk)


def unknown_name(unknown: int, known_axis: str = "x") -> str:
    """Name of an unknown of the covariance, for a sentence.

    Examples
    --------
    >>> unknown_name(5), unknown_name(7)
    ('the distance', 'the stretch along z')
    """
    names = ["the rotation"] * 3 + ["the position sideways", "the height", "the distance"]
    names += [f"the stretch along {'xyz'[axis]}" for axis in unknown_axes(known_axis)]
    return [*names, "the focal length"][unknown]


def _comparable(alignment: Alignment, unknowns: int) -> npt.NDArray[np.float64]:
    """Factors that give all unknowns the same kind of unit."""
    weights = np.ones(unknowns)
    weights[3:6] = 1 / max(float(np.linalg.norm(alignment.translation)), 1e-300)
    return weights
