"""Pixel conventions and lens models: from directions to image coordinates and back.

Image coordinates are relative to the principal point, in focal lengths. Let theta be the angle
between a direction and the optical axis, and n the direction's unit vector across the axis. A lens
first maps the direction

- ``perspective``: to tan(theta) n, for theta below 90 degrees,
- ``fisheye``: to theta n (Kannala, Brandt, "A generic camera model and calibration method", 2006),

and then adds distortion: OpenCV's model with k1, k2, p1, p2, k3 to k6, or ``cv2.fisheye``'s.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError, quote

PIXEL_CENTRE = 0.5
"""Coordinates x and y of the top-left pixel's centre in OpenGL, COLMAP and NeRF programs."""
_MOST_NORMALISED = 1.5  # normalised coordinates are smaller, even outside the image [px]
_PLACEHOLDERS = (0.0, -1.0)  # both coordinates of keypoints that a detector did not find
_LEAST_PLACEHOLDERS = 2  # equal rows that are not a coincidence
_CROWD = 3  # keypoints at the same pixel
_CROWDED_SPAN = 32  # of an object whose keypoints do not coincide by chance [px]
_LEAST_SIZE = 16  # of an image in which an object of a pixel or so is a mistake [px]

PixelOrigin = Literal["center", "corner"]
"""Position of (0, 0): the centre of the top-left pixel, or the image's top-left corner."""


def shift_of(pixel_origin: object, *, where: str = "pixel_origin") -> float:
    """Coordinate of the top-left pixel's centre in a convention [px]: 0 or 0.5."""
    if not isinstance(pixel_origin, str) or pixel_origin not in get_args(PixelOrigin):
        fix = 'give "center" (of the top-left pixel) or "corner" (of the image)'
        what = f"{quote(pixel_origin)} is not a place of pixel (0, 0)"
        raise InputError(what, where=where, fix=fix)
    return PIXEL_CENTRE if pixel_origin == "corner" else 0.0


def rescaled_pixels(pixels: FloatArray, factor: float | FloatArray) -> FloatArray:
    """Pixels (n, 2), or coordinates (n,), after the image is resized by ``factor``.

    The image's borders are fixed, pixel centres are not.
    """
    return np.asarray((pixels + PIXEL_CENTRE) * factor - PIXEL_CENTRE)


def missing_pixels(points_2d: FloatArray, *, least: int = _LEAST_PLACEHOLDERS) -> BoolArray:
    """Mask (n,) of pixels (n, 2) that detectors write for keypoints that they did not find.

    These are values that are not finite; exactly (0, 0) or (-1, -1) if it occurs at least ``least``
    times; and a pixel that three or more keypoints share.
    """
    bad = np.asarray(~np.isfinite(points_2d).all(axis=1))
    for _, here in _placeholders(points_2d, least):
        bad |= here
    known = points_2d[~bad]
    rows = list(map(tuple, known.tolist()))
    is_repeated = len(rows) - len(set(rows)) >= _CROWD - 1
    if is_repeated and np.ptp(known, axis=0).max() >= _CROWDED_SPAN:
        times = Counter(rows)
        bad[~bad] = [times[row] >= _CROWD for row in rows]
    return np.asarray(bad)


def check_pixels(points_2d: FloatArray, width: int, height: int, *, where: str) -> None:
    """Check that points (n, 2) are pixels of an image of the given size.

    Raises InputError if several are detectors' placeholders (see `missing_pixels`), or if all are
    normalised coordinates: distinct and within about a pixel of the image's corner.

    Examples
    --------
    >>> check_pixels(np.array([[0.2, 0.9], [0.7, 0.4]]), 640, 480, where="points_2d")
    Traceback (most recent call last):
    cadalign.errors.InputError: points_2d: all 2 keypoints ... give pixels: multiply fractions ...
    """
    if not len(points_2d):
        return
    _refuse_placeholders(points_2d, where)
    if abs(points_2d.item(0)) > _MOST_NORMALISED:
        return
    if min(width, height) < _LEAST_SIZE or not np.ptp(points_2d, axis=0).any():
        return
    if np.abs(points_2d).max() <= _MOST_NORMALISED:
        what = f"all {len(points_2d)} keypoints lie within {_MOST_NORMALISED:g} px of pixel (0, 0)"
        fix = f"give pixels: multiply fractions by the image's width {width} and height {height}"
        raise InputError(f"{what}, as normalised coordinates (0 to 1) do", where=where, fix=fix)


def _refuse_placeholders(points_2d: FloatArray, where: str) -> None:
    for value, here in _placeholders(points_2d, _LEAST_PLACEHOLDERS):
        rows = np.flatnonzero(here)
        listed = ", ".join(map(str, rows[:5])) + (", ..." if len(rows) > 5 else "")
        what = f"{len(rows)} keypoints, rows {listed}, are at exactly ({value:g}, {value:g})"
        fix = "detectors write this for keypoints that they did not find: leave these out"
        raise InputError(what, where=where, fix=fix)


def _placeholders(points_2d: FloatArray, least: int) -> Iterator[tuple[float, BoolArray]]:
    """Placeholders that occur at least ``least`` times, each with a mask (n,) of its rows."""
    if len(points_2d) and points_2d.min() > 0:  # a quick test
        return
    for value in _PLACEHOLDERS:
        here = (points_2d == value).all(axis=1)
        if np.count_nonzero(here) >= least:
            yield value, here


def perspective(points_cam: FloatArray) -> FloatArray:
    """Normalised image coordinates (n, 2) of camera-frame points (n, 3); not finite at depth 0."""
    return points_cam[:, :2] / points_cam[:, 2:]


# Lenses ------------------------------------------------------------------------------------------

LensKind = Literal["perspective", "fisheye"]
"""Kind of a lens, by its radial projection."""

# Allowed numbers of coefficients by kind of lens, and the remedy for a message.
_COEFFICIENTS = {
    "perspective": (
        (0, 4, 5, 8),
        "give (k1, k2, p1, p2), optionally followed by k3 or k3, k4, k5, k6",
    ),
    "fisheye": ((0, 4), "give (k1, k2, k3, k4)"),
}
_EXTENDED_COUNTS = (12, 14)  # OpenCV's, with thin prism terms, and with the sensor's tilt
_NEWTON_STEPS = 50
_TABLE = 257  # number of angles at which a fisheye's radius is tabulated
_REAL = 1e-9  # relative imaginary part below which a root counts as real
_MOST = 1e30  # bound on coefficients; smaller ones than its inverse count as 0


def check_coefficients(kind: object, coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Check and complete the coefficients of a lens.

    All-zero coefficients of a perspective lens become (), those missing of a fisheye become 0.
    Raises InputError if the kind is unknown, or the coefficients don't fit it.
    """
    if not isinstance(kind, str) or kind not in _COEFFICIENTS:
        what, fix = f"{quote(kind)} is not a kind of lens", f"known are {', '.join(_COEFFICIENTS)}"
        raise InputError(what, where="camera.lens", fix=fix)
    counts, fix = _COEFFICIENTS[kind]
    if kind == "perspective" and len(coefficients) in _EXTENDED_COUNTS:
        if any(coefficients[8:]):
            what = f"thin prisms and a tilted sensor, {quote(coefficients[8:])}, are not modelled"
            fix = "calibrate without cv2.CALIB_THIN_PRISM_MODEL and cv2.CALIB_TILTED_MODEL"
            raise InputError(what, where="camera.distortion", fix=fix)
        coefficients = coefficients[:8]
    if len(coefficients) not in counts or not np.isfinite(coefficients).all():
        what = f"{quote(coefficients)} are not distortion coefficients"
        raise InputError(what, where="camera.distortion", fix=fix)
    if kind == "perspective" and not any(coefficients):
        return ()
    return (0.0,) * 4 if kind == "fisheye" and not coefficients else coefficients


def require_perspective_lens(kind: str, *, where: str) -> None:
    """Raise an InputError for a wide lens, whose focal length must be known."""
    if kind != "perspective":
        fix = "calibrate the camera; only a perspective lens's focal length is estimated"
        raise InputError(f"the focal length of a {kind} lens is unknown", where=where, fix=fix)


@lru_cache(maxsize=64)
def _terms(kind: LensKind, coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Terms of a distortion: radial numerator n1 to n4, denominator d1 to d3, tangential p1, p2."""
    if kind == "fisheye":
        return (*coefficients, *(0.0,) * 5)
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients + (0.0,) * (8 - len(coefficients))
    return k1, k2, k3, 0.0, k4, k5, k6, p1, p2


@lru_cache(maxsize=64)
def largest_angle(coefficients: tuple[float, ...]) -> float:
    """Angle off the axis [rad] up to which a fisheye's image radius increases with the angle."""
    n1, n2, n3, n4 = coefficients
    with np.errstate(over="ignore"):
        # Derivative of theta (1 + n1 theta^2 + n2 theta^4 + ...), a polynomial in theta^2.
        slope = np.array([9 * n4, 7 * n3, 5 * n2, 3 * n1, 1.0]).clip(-_MOST, _MOST)
    slope[np.abs(slope) < 1 / _MOST] = 0.0
    roots = np.roots(slope)
    ends = roots.real[(np.abs(roots.imag) < _REAL * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(ends).min(initial=math.pi))


def image_of(
    points: FloatArray, kind: LensKind, coefficients: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Image coordinates (n, 2) of points (n, 3), and their derivatives (n, 2, 3) by the points."""
    plane, by_point = _project_undistorted(points, kind)
    distorted, by_plane = distort(plane, kind, coefficients)
    return distorted, by_plane @ by_point


def _project_undistorted(points: FloatArray, kind: LensKind) -> tuple[FloatArray, FloatArray]:
    """Image coordinates (n, 2) before distortion, and their derivatives (n, 2, 3)."""
    z = points[:, 2]
    if kind == "perspective":
        plane = perspective(points)
        ones = np.broadcast_to(np.eye(2), (len(plane), 2, 2))
        return plane, np.concatenate([ones, -plane[:, :, None]], axis=2) / z[:, None, None]
    r = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(r, z)
    on_axis = r == 0
    safe = np.where(on_axis, 1.0, r)
    across = np.where(on_axis[:, None], (1.0, 0.0), points[:, :2] / safe[:, None])
    stretch = np.where(on_axis, 1.0, theta) / np.where(on_axis, z, safe)
    outwards = np.column_stack([across * z[:, None], -r]) / (r * r + z * z)[:, None]
    by_point = across[:, :, None] * outwards[:, None]
    sideways = np.eye(2) - across[:, :, None] * across[:, None]
    by_point[:, :, :2] += stretch[:, None, None] * sideways
    return theta[:, None] * across, by_point


def rays_of_image(
    image: FloatArray, coefficients: tuple[float, ...]
) -> tuple[FloatArray, BoolArray]:
    """Unit directions (n, 3) of a fisheye's image coordinates (n, 2), and a mask of valid ones.

    A table of the radial part gives the initial values of Newton's method.
    """
    radius = np.hypot(image[:, 0], image[:, 1])
    theta = np.interp(radius, *_radii(coefficients))
    start = image * (theta / np.where(radius == 0, 1.0, radius))[:, None]
    plane, valid = undistort(image, "fisheye", coefficients, start=start)
    theta = radius = np.hypot(plane[:, 0], plane[:, 1])
    valid &= theta < largest_angle(coefficients)
    theta = np.where(valid, theta, 0.0)
    across = plane / np.where(radius == 0, 1.0, radius)[:, None]
    return np.column_stack([np.sin(theta)[:, None] * across, np.cos(theta)]), valid


@lru_cache(maxsize=64)
def _radii(coefficients: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Tabulate a fisheye's image radii and their angles [rad], both (`_TABLE`,)."""
    n1, n2, n3, n4 = coefficients
    angles = np.linspace(0.0, largest_angle(coefficients), _TABLE)
    s = angles * angles
    return angles * (1 + s * (n1 + s * (n2 + s * (n3 + s * n4)))), angles


def distort(
    normalized: FloatArray, kind: LensKind, coefficients: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Distort image coordinates (n, 2); returns also the derivatives (n, 2, 2)."""
    n1, n2, n3, n4, d1, d2, d3, p1, p2 = _terms(kind, coefficients)
    x, y = normalized[:, 0], normalized[:, 1]
    r2 = x * x + y * y
    numerator = 1 + r2 * (n1 + r2 * (n2 + r2 * (n3 + r2 * n4)))
    denominator = 1 + r2 * (d1 + r2 * (d2 + r2 * d3))
    radial = numerator / denominator
    # d radial / d r2
    slope = (n1 + r2 * (2 * n2 + r2 * (3 * n3 + r2 * 4 * n4))) / denominator
    slope = slope - radial * (d1 + r2 * (2 * d2 + 3 * d3 * r2)) / denominator
    distorted = np.empty((len(x), 2))
    distorted[:, 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    distorted[:, 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    mixed = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian = np.empty((len(x), 2, 2))
    jacobian[:, 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = mixed
    jacobian[:, 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return distorted, jacobian


def undistort(
    distorted: FloatArray,
    kind: LensKind,
    coefficients: tuple[float, ...],
    *,
    start: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Invert `distort` by Newton's method from ``start`` (n, 2); returns also a mask of success."""
    normalized = distorted.copy() if start is None else start
    active, errors = np.arange(len(distorted)), np.empty(len(distorted))
    for steps in range(_NEWTON_STEPS + 1):
        value, jacobian = distort(normalized[active], kind, coefficients)
        error = value - distorted[active]
        errors[active] = largest = np.abs(error).max(axis=1, initial=0.0)
        (a, b), (c, d) = jacobian.transpose(1, 2, 0)
        determinant = a * d - b * c
        # Beyond the fold of the lens model, Newton's method would find points that are not seen.
        going = (largest >= 1e-14) & (determinant > 0) & np.isfinite(determinant)
        active, error = active[going], error[going]
        if not len(active) or steps == _NEWTON_STEPS:
            break
        a, b, c, d, determinant = (row[going] for row in (a, b, c, d, determinant))
        x, y = error.T
        step = np.stack([d * x - b * y, a * y - c * x], axis=1) / determinant[:, None]
        normalized[active] -= step
    lost = ~np.isfinite(normalized).all(axis=1)
    normalized[lost] = distorted[lost]
    return normalized, np.asarray((errors < 1e-9) & ~lost)
