"""Pixels, their conventions, and lenses: places of directions in the image, and the inverse.

The place of a direction is in focal lengths, from the principal point. With theta the angle between
a direction and the optical axis and n its unit vector across the axis, a lens first maps

- ``perspective``: to tan(theta) n, for theta below 90 degrees,
- ``fisheye``: to theta n (Kannala, Brandt, "A generic camera model and calibration method", 2006),

and then adds distortion: OpenCV's model with k1, k2, p1, p2, k3 to k6, or that of ``cv2.fisheye``.
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
"""The centre of the top-left pixel, in x and y, in OpenGL, COLMAP and NeRF programs."""
_NORMALISED = 1.5  # beyond all normalised coordinates of what is guessed outside of an image [px]
_PLACEHOLDERS = (0.0, -1.0)  # of both coordinates of a keypoint that was not found
_SEVERAL = 2  # of these, which no detector finds by chance
_CROWD = 3  # keypoints at one and the same pixel
_CROWDED_SPAN = 32  # of an object in which so many do not meet [px]
_LEAST_SIZE = 16  # of an image in which so small an object is a mistake [px]

PixelOrigin = Literal["center", "corner"]
"""Place of pixel (0, 0): the centre of the top-left pixel, or the image's top-left corner."""


def shift_of(pixel_origin: object, *, where: str = "pixel_origin") -> float:
    """Coordinates of the top-left pixel's centre under a convention [px]: 0 or 0.5."""
    if not isinstance(pixel_origin, str) or pixel_origin not in get_args(PixelOrigin):
        fix = 'give "center" (of the top-left pixel) or "corner" (of the image)'
        what = f"{quote(pixel_origin)} is not a place of pixel (0, 0)"
        raise InputError(what, where=where, fix=fix)
    return PIXEL_CENTRE if pixel_origin == "corner" else 0.0


def rescaled_pixels(pixels: FloatArray, factor: float | FloatArray) -> FloatArray:
    """Pixels (n, 2), or coordinates (n,), in an image ``factor`` times as large.

    Borders stay in place, centres do not.
    """
    return np.asarray((pixels + PIXEL_CENTRE) * factor - PIXEL_CENTRE)


def unmeasured(points_2d: FloatArray, *, least: int = _SEVERAL) -> BoolArray:
    """Say which rows of pixels (n, 2) are no measurements, (n,) bool.

    These are what detectors write for keypoints that they did not find: values that are not finite;
    exactly (0, 0) or (-1, -1), if it is written ``least`` times; and a pixel that three or more
    share.
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
    """Refuse what is no pixels (n, 2) of an image of that size.

    Raises InputError if several are placeholders of detectors, see `unmeasured`, or if all are
    normalised coordinates: within a pixel or so of the image's corner, but not in one place.

    Examples
    --------
    >>> check_pixels(np.array([[0.2, 0.9], [0.7, 0.4]]), 640, 480, where="points_2d")
    Traceback (most recent call last):
    cadalign.errors.InputError: points_2d: all 2 keypoints ... give pixels: multiply fractions ...
    """
    if not len(points_2d):
        return
    _refuse_placeholders(points_2d, where)
    if abs(points_2d.item(0)) > _NORMALISED:
        return
    if min(width, height) < _LEAST_SIZE or not np.ptp(points_2d, axis=0).any():
        return
    if np.abs(points_2d).max() <= _NORMALISED:
        what = f"all {len(points_2d)} keypoints lie within {_NORMALISED:g} px of pixel (0, 0)"
        fix = f"give pixels: multiply fractions by the image's width {width} and height {height}"
        raise InputError(f"{what}, as normalised coordinates (0 to 1) do", where=where, fix=fix)


def _refuse_placeholders(points_2d: FloatArray, where: str) -> None:
    for value, here in _placeholders(points_2d, _SEVERAL):
        rows = np.flatnonzero(here)
        listed = ", ".join(map(str, rows[:5])) + (", ..." if len(rows) > 5 else "")
        what = f"{len(rows)} keypoints, rows {listed}, are at exactly ({value:g}, {value:g})"
        fix = "detectors write this for keypoints that they did not find: leave these out"
        raise InputError(what, where=where, fix=fix)


def _placeholders(points_2d: FloatArray, least: int) -> Iterator[tuple[float, BoolArray]]:
    """Values of both coordinates that are written ``least`` times, and the rows (n,) of each."""
    if len(points_2d) and points_2d.min() > 0:  # which is quickly told
        return
    for value in _PLACEHOLDERS:
        here = (points_2d == value).all(axis=1)
        if np.count_nonzero(here) >= least:
            yield value, here


def perspective(points_cam: FloatArray) -> FloatArray:
    """Normalised image coordinates (n, 2) of points (n, 3); not finite at depth 0."""
    return points_cam[:, :2] / points_cam[:, 2:]


# Lenses ------------------------------------------------------------------------------------------

LensKind = Literal["perspective", "fisheye"]
"""The kind of a lens, by the curve that its radius in the image follows."""

# Numbers of coefficients that a lens of each kind may have, and how to give them.
_COEFFICIENTS = {
    "perspective": (
        (0, 4, 5, 8),
        "give (k1, k2, p1, p2), optionally followed by k3 or k3, k4, k5, k6",
    ),
    "fisheye": ((0, 4), "give (k1, k2, k3, k4)"),
}
_WITH_MORE = (12, 14)  # numbers of OpenCV's, with thin prism terms, and with the sensor's tilt
_NEWTON_STEPS = 50
_TABLE = 257  # angles at which a fisheye's radius is tabulated
_REAL = 1e-9  # imaginary part, relative, of a root that is real
_MOST = 1e30  # coefficient that stands for larger ones; those below its inverse count as 0


def checked_coefficients(kind: object, coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """The coefficients of a lens; none of a pinhole, and of a wide lens always all.

    Raises InputError if the kind is unknown, or has no such coefficients.
    """
    if not isinstance(kind, str) or kind not in _COEFFICIENTS:
        what, fix = f"{quote(kind)} is not a kind of lens", f"known are {', '.join(_COEFFICIENTS)}"
        raise InputError(what, where="camera.lens", fix=fix)
    counts, fix = _COEFFICIENTS[kind]
    if kind == "perspective" and len(coefficients) in _WITH_MORE:
        if any(coefficients[12:]):
            what = f"the sensor's tilt, {quote(coefficients[12:])}, is not modelled"
            fix = "calibrate without cv2.CALIB_TILTED_MODEL"
            raise InputError(what, where="camera.distortion", fix=fix)
        if any(coefficients[8:]):
            what = f"the thin prism terms s1 to s4, {quote(coefficients[8:12])}, are not modelled"
            fix = "calibrate without cv2.CALIB_THIN_PRISM_MODEL"
            raise InputError(what, where="camera.distortion", fix=fix)
        coefficients = coefficients[:8]
    if len(coefficients) not in counts or not np.isfinite(coefficients).all():
        what = f"{quote(coefficients)} are not distortion coefficients"
        raise InputError(what, where="camera.distortion", fix=fix)
    if kind == "perspective" and not any(coefficients):
        return ()
    return (0.0,) * 4 if kind == "fisheye" and not coefficients else coefficients


def require_perspective_lens(kind: str, *, where: str) -> None:
    """Refuse a wide lens whose focal length is unknown."""
    if kind != "perspective":
        fix = "calibrate the camera; only a perspective lens's focal length is estimated"
        raise InputError(f"the focal length of a {kind} lens is unknown", where=where, fix=fix)


@lru_cache(maxsize=64)
def _terms(kind: LensKind, coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Terms of a distortion: four radial n over three d, and two tangential p."""
    if kind == "fisheye":
        return (*coefficients, *(0.0,) * 5)
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients + (0.0,) * (8 - len(coefficients))
    return k1, k2, k3, 0.0, k4, k5, k6, p1, p2


@lru_cache(maxsize=64)
def largest_angle(coefficients: tuple[float, ...]) -> float:
    """Angle off the axis [rad] up to which a fisheye maps outer directions farther out."""
    n1, n2, n3, n4 = coefficients
    with np.errstate(over="ignore"):
        # The slope of theta (1 + n1 theta^2 + n2 theta^4 + ...), by the square of theta.
        slope = np.array([9 * n4, 7 * n3, 5 * n2, 3 * n1, 1.0]).clip(-_MOST, _MOST)
    slope[np.abs(slope) < 1 / _MOST] = 0.0
    roots = np.roots(slope)
    ends = roots.real[(np.abs(roots.imag) < _REAL * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(ends).min(initial=math.pi))


def image_of(
    points: FloatArray, kind: LensKind, coefficients: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Place (n, 2) of points (n, 3) in the image, and its derivatives (n, 2, 3) by the points."""
    plane, by_point = _plane_of(points, kind)
    distorted, by_plane = distort(plane, kind, coefficients)
    return distorted, by_plane @ by_point


def _plane_of(points: FloatArray, kind: LensKind) -> tuple[FloatArray, FloatArray]:
    """Place (n, 2) before distortion, and its derivatives (n, 2, 3)."""
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
    """Unit directions (n, 3) of places (n, 2) in the image of a fisheye, and where they exist.

    A table of the radial part gives the start of the search.
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
    """Radii in a fisheye's image, and their angles [rad], both (`_TABLE`,)."""
    n1, n2, n3, n4 = coefficients
    angles = np.linspace(0.0, largest_angle(coefficients), _TABLE)
    s = angles * angles
    return angles * (1 + s * (n1 + s * (n2 + s * (n3 + s * n4)))), angles


def distort(
    normalized: FloatArray, kind: LensKind, coefficients: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Distorted coordinates (n, 2) of undistorted ones (n, 2), and their derivatives (n, 2, 2)."""
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
    """Invert `distort` by Newton's method from ``start`` (n, 2), and say where that succeeded."""
    normalized = distorted.copy() if start is None else start
    active, errors = np.arange(len(distorted)), np.empty(len(distorted))
    for steps in range(_NEWTON_STEPS + 1):
        value, jacobian = distort(normalized[active], kind, coefficients)
        error = value - distorted[active]
        errors[active] = largest = np.abs(error).max(axis=1, initial=0.0)
        (a, b), (c, d) = jacobian.transpose(1, 2, 0)
        determinant = a * d - b * c
        # Past the fold of the lens model the search would find a point that is not seen.
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
