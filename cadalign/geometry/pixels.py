"""Places of pixels, and normalised image coordinates by OpenCV's lens model with its inverse."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, quote

PIXEL_CENTRE = 0.5
"""The centre of the top-left pixel, in x and y, in OpenGL, COLMAP and NeRF programs."""

PixelOrigin = Literal["center", "corner"]
"""Place of pixel (0, 0): the centre of the top-left pixel, or the image's top-left corner."""


def shift_of(pixel_origin: object, *, where: str = "pixel_origin") -> float:
    """Coordinates of the top-left pixel's centre under a convention [px]: 0 or 0.5."""
    if not isinstance(pixel_origin, str) or pixel_origin not in get_args(PixelOrigin):
        raise InputError(
            f"{quote(pixel_origin)} is not a place of pixel (0, 0)",
            where=where,
            fix='give "center" (of the top-left pixel) or "corner" (of the image)',
        )
    return PIXEL_CENTRE if pixel_origin == "corner" else 0.0


def rescaled_pixels(pixels: FloatArray, factor: float | FloatArray) -> FloatArray:
    """Pixels (n, 2) in an image ``factor`` times as large: borders, not centres, stay in place.

    Examples
    --------
    >>> rescaled_pixels(np.array([[0.0, 9.5]]), 2).tolist()
    [[0.5, 19.5]]
    """
    return np.asarray((pixels + PIXEL_CENTRE) * factor - PIXEL_CENTRE)


def perspective(points_cam: FloatArray) -> FloatArray:
    """Normalised image coordinates (n, 2) of points (n, 3); not finite at depth 0."""
    return points_cam[:, :2] / points_cam[:, 2:]


def distort(
    normalized: FloatArray, coefficients: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Distorted coordinates (n, 2) of normalised ones (n, 2), and their derivatives (n, 2, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients + (0.0,) * (8 - len(coefficients))
    x, y = normalized[:, 0], normalized[:, 1]
    r2 = x * x + y * y
    numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = numerator / denominator
    # d radial / d r2
    slope = (k1 + r2 * (2 * k2 + 3 * k3 * r2)) / denominator - radial * (
        k4 + r2 * (2 * k5 + 3 * k6 * r2)
    ) / denominator
    distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )
    mixed = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian = np.stack(
        [
            np.stack([radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, mixed], axis=1),
            np.stack([mixed, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x], axis=1),
        ],
        axis=1,
    )
    return distorted, jacobian


def undistort(
    distorted: FloatArray, coefficients: tuple[float, ...]
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Invert the lens model by Newton's method, and say where that succeeded."""
    normalized = distorted.copy()
    active = np.arange(len(distorted))
    for _ in range(50):
        value, jacobian = distort(normalized[active], coefficients)
        error = value - distorted[active]
        (a, b), (c, d) = jacobian.transpose(1, 2, 0)
        determinant = a * d - b * c
        # Past the fold of the lens model the search would find a point that is not seen.
        going = (np.abs(error).max(axis=1) >= 1e-14) & (determinant > 0)
        going &= np.isfinite(determinant)
        active, error = active[going], error[going]
        if not len(active):
            break
        a, b, c, d, determinant = (row[going] for row in (a, b, c, d, determinant))
        x, y = error.T
        step = np.stack([d * x - b * y, a * y - c * x], axis=1) / determinant[:, None]
        normalized[active] -= step
    lost = ~np.isfinite(normalized).all(axis=1)
    normalized[lost] = distorted[lost]
    error = np.abs(distort(normalized, coefficients)[0] - distorted).max(axis=1, initial=0.0)
    return normalized, np.asarray((error < 1e-9) & ~lost)
