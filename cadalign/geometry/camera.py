"""The calibrated camera: from camera-frame points to pixels and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_points, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.conventions import PIXEL_CENTRE
from cadalign.geometry.distortion import distort, undistort
from cadalign.geometry.projection import perspective

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
    focal_known : bool
        False for a camera whose focal lengths are placeholders; see `without_focal`.

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
    focal_known: bool = field(default=True, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not is_number(size) or int(size) != size or size < 1:
                what = f"{quote(size)} is not a size"
                raise InputError(what, where=f"camera.{name}", fix=_SIZE_FIX)
            object.__setattr__(self, name, int(size))
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not is_number(value):
                raise InputError(f"{quote(value)} is not a finite number", where=f"camera.{name}")
            object.__setattr__(self, name, float(value))
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise InputError(
                    f"the focal length is {getattr(self, name):g}",
                    where=f"camera.{name}",
                    fix="give the calibrated focal length in pixels",
                )
        known: object = self.focal_known
        if not isinstance(known, bool | np.bool_):
            what = f"{quote(known)} is neither True nor False"
            raise InputError(what, where="camera.focal_known")
        try:
            if np.iscomplexobj(self.distortion) or np.ma.is_masked(self.distortion):
                raise TypeError
            coefficients = tuple(float(value) for value in self.distortion)
        except (TypeError, ValueError, OverflowError, NotImplementedError):  # of a memoryview
            raise InputError("not a sequence of numbers", where="camera.distortion") from None
        if len(coefficients) not in (0, 4, 5, 8) or not np.isfinite(coefficients).all():
            raise InputError(
                f"{quote(coefficients)} are not distortion coefficients",
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
        if not is_number(fov_x) or not 0 < fov_x < 180:
            raise InputError(f"{quote(fov_x)} is not between 0 and 180 degrees", where="fov_x")
        for name, size in (("width", width), ("height", height)):
            if not is_number(size):
                what = f"{quote(size)} is not a size"
                raise InputError(what, where=f"camera.{name}", fix=_SIZE_FIX)
        with np.errstate(over="ignore"):
            focal = 0.5 * width / np.tan(np.radians(fov_x) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @classmethod
    def without_focal(
        cls,
        width: int,
        height: int,
        *,
        cx: float | None = None,
        cy: float | None = None,
        distortion: tuple[float, ...] = (),
    ) -> Camera:
        """Make a camera of which only the image is known, for ``fit(..., focal="estimate")``.

        Its pixels are square. ``fx`` and ``fy`` are placeholders; `project`, `normalize` and fits
        with a known focal length refuse it.

        Parameters
        ----------
        width, height : int
            Image size [px].
        cx, cy : float, optional
            Principal point [px]; the image's centre by default.
        distortion : tuple of float, optional
            As for `Camera`.

        Examples
        --------
        >>> camera = Camera.without_focal(640, 480)
        >>> camera.cx, camera.cy, camera.focal_known
        (319.5, 239.5, False)
        >>> camera.with_focal(700).fy
        700.0
        """
        if not is_number(width) or not is_number(height) or min(width, height) < 1:
            raise InputError(
                f"{quote(width)} x {quote(height)} is not a size",
                where="camera.width",
                fix=_SIZE_FIX,
            )
        placeholder = float(max(width, height))
        return cls(
            width,
            height,
            placeholder,
            placeholder,
            (width - 1) / 2 if cx is None else cx,
            (height - 1) / 2 if cy is None else cy,
            distortion,
            focal_known=False,
        )

    def with_focal(self, focal: float) -> Camera:
        """The same camera with the horizontal focal length ``focal`` [px], known from now on.

        The shape of its pixels stays: ``fy`` changes in proportion.
        """
        if not is_number(focal):
            raise InputError(f"{quote(focal)} is not a finite number", where="focal")
        return replace(self, fx=focal, fy=focal * (self.fy / self.fx), focal_known=True)

    @property
    def matrix(self) -> FloatArray:
        """The calibration matrix K, (3, 3) float."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=float)

    def require_focal(self) -> None:
        """Refuse a camera `without_focal`.

        Raises
        ------
        InputError
            If the focal length is unknown.
        """
        if not self.focal_known:
            raise InputError(
                "the focal length is unknown",
                where="camera",
                fix='estimate it with focal="estimate", or give it: camera.with_focal(...)',
            )

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
            If a point lies in or behind the camera's plane (z <= 0), or the focal length is
            unknown.
        """
        self.require_focal()
        points = as_points(points_cam, name="points_cam", dimension=3)
        behind = np.flatnonzero(points[:, 2] <= 0)
        if len(behind):
            raise InputError(
                f"{len(behind)} of {len(points)} points lie behind the camera, "
                f"the first is point {behind[0]} with z = {points[behind[0], 2]:g}",
                where="points_cam",
                fix="only points with z > 0 have a projection",
            )
        return self.pixels_from_normalized(perspective(points))

    def project_where_ahead(self, points_cam: FloatArray) -> FloatArray:
        """Project points (n, 3) of the camera frame; pixels (n, 2), infinite behind the camera."""
        pixels = np.full((len(points_cam), 2), np.inf)
        ahead = points_cam[:, 2] > 0
        pixels[ahead] = self.pixels_from_normalized(perspective(points_cam[ahead]))
        return pixels

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
            If the lens model cannot be inverted at a pixel (far outside the calibrated image), or
            the focal length is unknown.
        """
        self.require_focal()
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
        with np.errstate(over="ignore", invalid="ignore"):  # lens polynomials
            distorted = (points - (self.cx, self.cy)) / (self.fx, self.fy)
            if not self.distortion:
                return distorted, np.ones(len(points), dtype=bool)
            return undistort(distorted, self.distortion)

    def pixels_from_normalized(self, normalized: FloatArray) -> FloatArray:
        """Apply lens and calibration matrix to (n, 2) normalised coordinates; gives pixels."""
        with np.errstate(over="ignore", invalid="ignore"):  # far outside the lens model's field
            if self.distortion:
                normalized, _ = distort(normalized, self.distortion)
            return normalized * (self.fx, self.fy) + (self.cx, self.cy)

    def distortion_jacobian(self, normalized: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 2) of distorted by normalised image coordinates (n, 2)."""
        if not self.distortion:
            return np.broadcast_to(np.eye(2), (len(normalized), 2, 2))
        return distort(normalized, self.distortion)[1]

    def contains(self, points_2d: FloatArray, *, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Say which pixels (n, 2) lie inside the image by at least ``margin`` [px]; (n,) bool."""
        low = -0.5 + margin
        high = np.array([self.width, self.height]) - 0.5 - margin
        return np.asarray(((points_2d >= low) & (points_2d <= high)).all(axis=1))

    def to_dict(self) -> dict[str, Any]:
        """Write the camera as COLMAP does: ``{"model", "width", "height", "params"}``.

        COLMAP puts the centre of the top-left pixel at (0.5, 0.5), so the principal point there
        is larger by half a pixel than ``cx`` and ``cy`` here. An unknown focal length is None,
        ``null`` in JSON.

        Examples
        --------
        >>> Camera(640, 480, 500, 500, 319.5, 239.5).to_dict()["params"]
        [500.0, 500.0, 320.0, 240.0]
        """
        model = {0: "PINHOLE", 4: "OPENCV"}.get(len(self.distortion), "FULL_OPENCV")
        values: dict[str, float | None]
        values = dict(zip(_DISTORTION_NAMES, self.distortion, strict=False))
        values |= {
            "fx": self.fx if self.focal_known else None,
            "fy": self.fy if self.focal_known else None,
            "cx": self.cx + PIXEL_CENTRE,
            "cy": self.cy + PIXEL_CENTRE,
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
            ``width``, ``height``, and ``params`` in COLMAP's order and pixel convention. None in
            the place of the focal lengths, or ``width`` and ``height`` alone, give a camera
            `without_focal`.

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
        if set(data) == {"width", "height"}:
            return cls.without_focal(data["width"], data["height"])
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
                f"unknown model {quote(model)}", where="camera.model", fix=f"known are {known}"
            )
        names = COLMAP_PARAMS[model]
        params = data["params"]
        params = params.tolist() if isinstance(params, np.ndarray) else params
        if not isinstance(params, list | tuple) or len(params) != len(names):
            raise InputError(
                f"{quote(params)} are not the parameters of {model}",
                where="camera.params",
                fix=f"give {', '.join(names)}",
            )
        values = dict(zip(names, params, strict=True))
        focals = [name for name in names if name.startswith("f")]
        is_known = any(values[name] is not None for name in focals)
        for name, value in values.items():
            if not is_number(value) and (is_known or name not in focals):
                what = f"{name} is {quote(value)}, not a finite number"
                raise InputError(what, where="camera.params")
        coefficients = tuple(values.get(name, 0.0) for name in _DISTORTION_NAMES)
        cx, cy = values["cx"] - PIXEL_CENTRE, values["cy"] - PIXEL_CENTRE
        distortion = coefficients if any(coefficients[4:]) else coefficients[:4]
        size = data["width"], data["height"]
        if not is_known:
            return cls.without_focal(*size, cx=cx, cy=cy, distortion=distortion)
        return cls(*size, values[focals[0]], values[focals[-1]], cx, cy, distortion)


_SIZE_FIX = "give the image size in whole pixels"
