"""The calibrated camera: from camera-frame points to pixels and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError
from cadalign.validation import FloatArray, as_points

# COLMAP's camera models: the names of their parameters, in COLMAP's order.
COLMAP_PARAMS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# COLMAP puts the centre of the top-left pixel at (0.5, 0.5), cadalign and OpenCV at (0, 0).
_COLMAP_PIXEL_CENTRE = 0.5


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with optional lens distortion.

    Camera axes are OpenCV's: x right, y down, z forward. Integer pixel coordinates are pixel
    centres: the top-left pixel's centre is (0, 0), the image spans [-0.5, width - 0.5].

    Parameters
    ----------
    width, height : int
        Image size [px].
    fx, fy : float
        Focal lengths [px].
    cx, cy : float
        Principal point [px].
    distortion : tuple of float, optional
        OpenCV's coefficients in OpenCV's order: (k1, k2, p1, p2), or with k3, or with
        k3, k4, k5, k6. Empty for a lens without distortion.

    Raises
    ------
    InputError
        If a size is not a positive integer, a focal length is missing or not positive, a value is
        not finite, or the number of coefficients is none of 0, 4, 5, 8.

    Examples
    --------
    >>> camera = Camera(width=640, height=480, fx=500, fy=500, cx=319.5, cy=239.5)
    >>> camera.project([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0]]).tolist()
    [[319.5, 239.5], [369.5, 239.5]]
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not _is_number(size) or int(size) != size or size < 1:
                raise InputError(f"{size!r} is not a size", where=f"camera.{name}", fix=_SIZE_FIX)
            object.__setattr__(self, name, int(size))
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not _is_number(value):
                raise InputError(f"{value!r} is not a finite number", where=f"camera.{name}")
            object.__setattr__(self, name, float(value))
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise InputError(
                    f"the focal length is {getattr(self, name):g}",
                    where=f"camera.{name}",
                    fix="give the calibrated focal length in pixels",
                )
        try:
            coefficients = tuple(float(value) for value in self.distortion)
        except (TypeError, ValueError):
            raise InputError("not a sequence of numbers", where="camera.distortion") from None
        if len(coefficients) not in (0, 4, 5, 8) or not np.isfinite(coefficients).all():
            raise InputError(
                f"{coefficients!r} are not distortion coefficients",
                where="camera.distortion",
                fix="give (k1, k2, p1, p2), optionally followed by k3 or k3, k4, k5, k6",
            )
        object.__setattr__(self, "distortion", coefficients if any(coefficients) else ())

    @classmethod
    def from_fov(cls, width: int, height: int, *, fov_x: float) -> Camera:
        """Make a camera with square pixels from its horizontal field of view.

        Parameters
        ----------
        width, height : int
            Image size [px].
        fov_x : float
            Horizontal field of view [degrees], from one edge of the image to the other.

        Examples
        --------
        >>> round(Camera.from_fov(640, 480, fov_x=90.0).fx, 6)
        320.0
        """
        if not _is_number(fov_x) or not 0 < fov_x < 180:
            raise InputError(f"{fov_x!r} is not between 0 and 180 degrees", where="fov_x")
        focal = 0.5 * width / np.tan(np.radians(fov_x) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def matrix(self) -> FloatArray:
        """The calibration matrix K, (3, 3) float."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=float)

    def project(self, points_cam: npt.ArrayLike) -> FloatArray:
        """Project points of the camera frame into the image.

        Parameters
        ----------
        points_cam : (n, 3) float
            Points in the camera frame, in front of it.

        Returns
        -------
        (n, 2) float
            Pixels; they may lie outside the image.

        Raises
        ------
        InputError
            If a point lies in or behind the camera's plane (z <= 0).
        """
        points = as_points(points_cam, name="points_cam", dimension=3)
        behind = np.flatnonzero(points[:, 2] <= 0)
        if len(behind):
            raise InputError(
                f"{len(behind)} of {len(points)} points lie behind the camera, "
                f"the first is point {behind[0]} with z = {points[behind[0], 2]:g}",
                where="points_cam",
                fix="only points with z > 0 have a projection",
            )
        return self.pixels_from_normalized(points[:, :2] / points[:, 2:])

    def normalize(self, points_2d: npt.ArrayLike) -> FloatArray:
        """Turn pixels into normalised image coordinates, the lens distortion removed.

        Parameters
        ----------
        points_2d : (n, 2) float
            Pixels.

        Returns
        -------
        (n, 2) float
            (u, v) such that (u, v, 1) is the direction of the pixel's ray.

        Raises
        ------
        InputError
            If the lens model cannot be inverted at a pixel (far outside the calibrated image).
        """
        normalized, valid = self.normalize_where_valid(points_2d)
        failed = np.flatnonzero(~valid)
        if len(failed):
            raise InputError(
                f"the lens distortion cannot be undone at {len(failed)} of {len(valid)} "
                f"pixels, the first is point {failed[0]}",
                where="points_2d",
                fix="these lie outside the area in which the lens model is valid; drop them",
            )
        return normalized

    def normalize_where_valid(
        self, points_2d: npt.ArrayLike
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Turn pixels into normalised image coordinates wherever the lens model can be inverted.

        Parameters
        ----------
        points_2d : (n, 2) float
            Pixels.

        Returns
        -------
        normalized : (n, 2) float
            As `normalize` gives them; meaningless, but finite, where not valid.
        valid : (n,) bool
        """
        points = as_points(points_2d, name="points_2d", dimension=2)
        distorted = (points - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.distortion:
            return distorted, np.ones(len(points), dtype=bool)
        return self._undistort(distorted)

    def pixels_from_normalized(self, normalized: FloatArray) -> FloatArray:
        """Apply lens and calibration matrix to (n, 2) normalised coordinates; gives pixels."""
        if self.distortion:
            normalized, _ = self._distort(normalized)
        return normalized * (self.fx, self.fy) + (self.cx, self.cy)

    def distortion_jacobian(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 2) of distorted by normalised image coordinates (n, 2)."""
        if not self.distortion:
            return np.broadcast_to(np.eye(2), (len(normalized), 2, 2))
        return self._distort(normalized)[1]

    def contains(self, points_2d: FloatArray, *, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Say which pixels (n, 2) lie inside the image by at least ``margin`` [px]; (n,) bool."""
        low = -0.5 + margin
        high = np.array([self.width, self.height]) - 0.5 - margin
        return np.asarray(((points_2d >= low) & (points_2d <= high)).all(axis=1))

    def _distort(self, normalized: FloatArray) -> tuple[FloatArray, FloatArray]:
        """OpenCV's lens model: distorted coordinates (n, 2) and their derivatives (n, 2, 2)."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self.distortion + (0.0,) * (8 - len(self.distortion))
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

    def _undistort(self, distorted: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Invert the lens model by Newton's method, and say where that succeeded."""
        normalized = distorted.copy()
        active = np.arange(len(distorted))
        for _ in range(50):
            value, jacobian = self._distort(normalized[active])
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
        error = np.abs(self._distort(normalized)[0] - distorted).max(axis=1, initial=0.0)
        return normalized, np.asarray((error < 1e-9) & ~lost)

    def to_dict(self) -> dict[str, Any]:
        """Write the camera as COLMAP does: ``{"model", "width", "height", "params"}``.

        COLMAP puts the centre of the top-left pixel at (0.5, 0.5), so the principal point there
        is larger by half a pixel than ``cx`` and ``cy`` here.

        Examples
        --------
        >>> Camera(640, 480, 500, 500, 319.5, 239.5).to_dict()["params"]
        [500.0, 500.0, 320.0, 240.0]
        """
        model = {0: "PINHOLE", 4: "OPENCV"}.get(len(self.distortion), "FULL_OPENCV")
        values = dict(zip(_DISTORTION_NAMES, self.distortion, strict=False))
        values |= {
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx + _COLMAP_PIXEL_CENTRE,
            "cy": self.cy + _COLMAP_PIXEL_CENTRE,
        }
        return {
            "model": model,
            "width": self.width,
            "height": self.height,
            "params": [values.get(name, 0.0) for name in COLMAP_PARAMS[model]],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Camera:
        """Read a camera in COLMAP's form; see `to_dict`.

        Parameters
        ----------
        data : mapping
            ``model`` (SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or FULL_OPENCV),
            ``width``, ``height``, and ``params`` in COLMAP's order and pixel convention.

        Raises
        ------
        InputError
            If a field is missing, the model is unknown, or the number of parameters is wrong.

        Examples
        --------
        >>> Camera.from_dict({"model": "SIMPLE_RADIAL", "width": 640, "height": 480,
        ...                   "params": [500, 320, 240, 0.1]}).distortion
        (0.1, 0.0, 0.0, 0.0)
        """
        if not isinstance(data, Mapping):
            raise InputError(f"expected an object, got {type(data).__name__}", where="camera")
        missing = [key for key in ("model", "width", "height", "params") if key not in data]
        if missing:
            raise InputError(
                f"missing {', '.join(missing)}",
                where="camera",
                fix='give {"model", "width", "height", "params"} as COLMAP does',
            )
        model = data["model"]
        if not isinstance(model, str) or model not in COLMAP_PARAMS:
            known = ", ".join(COLMAP_PARAMS)
            raise InputError(
                f"unknown model {model!r}", where="camera.model", fix=f"known are {known}"
            )
        names = COLMAP_PARAMS[model]
        params = data["params"]
        if not isinstance(params, list | tuple | np.ndarray) or len(params) != len(names):
            raise InputError(
                f"{params!r} are not the parameters of {model}",
                where="camera.params",
                fix=f"give {', '.join(names)}",
            )
        for name, value in zip(names, params, strict=True):
            if not _is_number(value):
                raise InputError(f"{name} is {value!r}, not a finite number", where="camera.params")
        values = dict(zip(names, params, strict=True))
        coefficients = tuple(values.get(name, 0.0) for name in _DISTORTION_NAMES)
        return cls(
            width=data["width"],
            height=data["height"],
            fx=values["fx"] if "fx" in values else values["f"],
            fy=values["fy"] if "fy" in values else values["f"],
            cx=values["cx"] - _COLMAP_PIXEL_CENTRE,
            cy=values["cy"] - _COLMAP_PIXEL_CENTRE,
            distortion=coefficients if any(coefficients[4:]) else coefficients[:4],
        )


_SIZE_FIX = "give the image size in whole pixels"


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float | np.integer | np.floating)
        and not isinstance(value, bool)
        and bool(np.isfinite(value))
    )
