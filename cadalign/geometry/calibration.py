"""Parameters of a calibrated camera: validation, plausibility checks and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats, is_masked, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.pixels import (
    PIXEL_CENTRE,
    LensKind,
    PixelOrigin,
    check_coefficients,
    require_perspective_lens,
    rescaled_pixels,
    shift_of,
)

# COLMAP's camera models: the names of their parameters, in COLMAP's order.
COLMAP_PARAMS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_C = TypeVar("_C", bound="Calibration")  # editors complete this, but not Self
_COEFFICIENTS: dict[LensKind, tuple[str, ...]] = {
    "perspective": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
_MODELS = {0: "PINHOLE", 4: "OPENCV"}  # COLMAP model by number of coefficients
_NO_SKEW = 1e-9  # relative to the focal length
_SIZE = ("width", "height")
_FORMS = {"params": ("model", *_SIZE, "params"), "matrix": ("matrix", *_SIZE)}
_MATRIX_FIELDS = (*_FORMS["matrix"], "pixel_origin", "distortion", "lens")

OTHER_SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
"""Usual factors by which a photo is resized."""
_FAR_FROM_MIDDLE = 0.3  # distance of the principal point from the image's middle, over its size
_SAME_MIDDLE = 0.02  # such a distance at which the principal point counts as the middle
_OBLONG = 1.1  # ratio of a pixel's sides
_WIDEST_DEG = 120.0  # angle of view of a camera without a lens model


@dataclass(frozen=True)
class Calibration:
    """Image size, focal lengths, principal point and lens; see `cadalign.Camera`."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    lens: LensKind = field(default="perspective", kw_only=True)
    focal_known: bool = field(default=True, kw_only=True, repr=False)
    turn: tuple[float, ...] = field(default=(), kw_only=True, repr=False)
    """Rotation from a frame of `Camera.rotate` to the lens's, by rows; empty if not turned."""

    def __post_init__(self) -> None:
        for name in _SIZE:
            object.__setattr__(self, name, _whole_size(getattr(self, name), name))
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not is_number(value):
                raise InputError(f"{quote(value)} is not a finite number", where=f"camera.{name}")
            if name.startswith("f") and value <= 0:
                what, fix = f"the focal length is {value:g}", "give the calibrated one in pixels"
                raise InputError(what, where=f"camera.{name}", fix=fix)
            object.__setattr__(self, name, float(value))
        known: object = self.focal_known
        if not isinstance(known, bool | np.bool_):
            what = f"{quote(known)} is neither True nor False"
            raise InputError(what, where="camera.focal_known")
        coefficients = check_coefficients(self.lens, _as_coefficients(self.distortion))
        object.__setattr__(self, "distortion", coefficients)
        if not self.focal_known:
            require_perspective_lens(self.lens, where="camera.lens")

    @classmethod
    def from_fov(cls: type[_C], width: int, height: int, *, fov_x: float) -> _C:
        """Make a camera with square pixels from the horizontal field of view [degrees].

        Examples
        --------
        >>> from cadalign import Camera
        >>> round(Camera.from_fov(640, 480, fov_x=90.0).fx, 6)
        320.0
        """
        if not is_number(fov_x) or not 0 < fov_x < 180:
            raise InputError(f"{quote(fov_x)} is not between 0 and 180 degrees", where="fov_x")
        width, height = _whole_size(width, "width"), _whole_size(height, "height")
        with np.errstate(over="ignore"):
            focal = 0.5 * width / np.tan(np.radians(fov_x) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @classmethod
    def from_matrix(
        cls: type[_C],
        matrix: npt.ArrayLike,
        width: int,
        height: int,
        *,
        pixel_origin: PixelOrigin = "center",
        distortion: tuple[float, ...] = (),
        lens: LensKind = "perspective",
    ) -> _C:
        """Make a camera from its calibration matrix K.

        Parameters
        ----------
        matrix : (3, 3) float
            ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` [px], without skew.
        pixel_origin : {"center", "corner"}
            Origin of the principal point's coordinates: the centre of the top-left pixel (OpenCV,
            Kalibr, BOP), or the top-left corner of the image, half a pixel away (COLMAP,
            PyTorch3D, many renderers).

        Raises
        ------
        InputError
            If the matrix does not have this form, or a value is invalid.

        Examples
        --------
        >>> from cadalign import Camera
        >>> K = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
        >>> Camera.from_matrix(K, 640, 480, pixel_origin="corner").cx
        319.5
        """
        shift = shift_of(pixel_origin, where="camera.pixel_origin")
        values = as_floats(matrix, name="matrix", shape=(3, 3))
        (fx, _, cx), (_, fy, cy), _ = values.tolist()
        expected = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        if np.abs(values - expected).max() > _NO_SKEW * max(abs(fx), 1.0):
            what, form = quote(values.tolist()), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            what, fix = f"{what} is not of the form {form}", "give one without skew, by rows"
            raise InputError(what, where="matrix", fix=fix)
        return cls(width, height, fx, fy, cx - shift, cy - shift, distortion, lens=lens)

    @classmethod
    def from_size(
        cls: type[_C],
        width: int,
        height: int,
        *,
        cx: float | None = None,
        cy: float | None = None,
        distortion: tuple[float, ...] = (),
    ) -> _C:
        """Make a camera of unknown focal length, for ``fit(..., focal="estimate")``.

        Pixels are square; the principal point is the image's centre by default. ``fx`` and ``fy``
        are placeholders: `project`, `normalize` and fits with a known focal length refuse them.

        Examples
        --------
        >>> from cadalign import Camera
        >>> camera = Camera.from_size(640, 480)
        >>> camera.cx, camera.cy, camera.focal_known
        (319.5, 239.5, False)
        >>> camera.replace_focal(700).fy
        700.0
        """
        width, height = _whole_size(width, "width"), _whole_size(height, "height")
        focal = float(max(width, height))
        cx = (width - 1) / 2 if cx is None else cx
        cy = (height - 1) / 2 if cy is None else cy
        return cls(width, height, focal, focal, cx, cy, distortion, focal_known=False)

    def replace_focal(self: _C, focal: float) -> _C:
        """Replace the focal length by ``fx`` [px], then known; ``fy`` changes in proportion."""
        if not is_number(focal):
            raise InputError(f"{quote(focal)} is not a finite number", where="focal")
        return replace(self, fx=focal, fy=focal * (self.fy / self.fx), focal_known=True)

    def resize(self: _C, width: int, height: int) -> _C:
        """Make the camera of the image resized to ``width`` x ``height`` pixels.

        Examples
        --------
        >>> from cadalign import Camera
        >>> Camera(4, 2, fx=3, fy=3, cx=1.5, cy=0.5).resize(8, 4).cx
        3.5
        """
        factors = np.array([width / self.width, height / self.height])
        cx, cy = rescaled_pixels(np.array([self.cx, self.cy]), factors).tolist()
        fx, fy = (factors * (self.fx, self.fy)).tolist()
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def crop(self: _C, left: int, top: int, width: int, height: int) -> _C:
        """Make the camera of a crop of the image whose top-left pixel is (``left``, ``top``).

        The crop may reach beyond the image.

        Examples
        --------
        >>> from cadalign import Camera
        >>> camera = Camera(640, 480, fx=900, fy=900, cx=319.5, cy=239.5)
        >>> part = camera.crop(100, 50, 200, 300)
        >>> part.cx, part.cy, part.width
        (219.5, 189.5, 200)
        """
        cx, cy = self.cx - left, self.cy - top
        return replace(self, width=width, height=height, cx=cx, cy=cy)

    @property
    def matrix(self) -> FloatArray:
        """Calibration matrix K, (3, 3) float; integer coordinates are pixel centres."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=float)

    def require_focal(self) -> None:
        """Raise an InputError if the focal length is unknown."""
        if not self.focal_known:
            fix = 'estimate it with focal="estimate", or give it: camera.replace_focal(...)'
            raise InputError("the focal length is unknown", where="camera", fix=fix)

    def contains(self, points_2d: FloatArray, *, margin: float = 0.0) -> BoolArray:
        """Mask (...) of the pixels (..., 2) that lie at least ``margin`` [px] inside the image."""
        low = -0.5 + margin
        high = np.array([self.width, self.height]) - 0.5 - margin
        return np.asarray(((points_2d >= low) & (points_2d <= high)).all(axis=-1))

    def to_dict(self) -> dict[str, Any]:
        """Write the camera as COLMAP does: ``{"model", "width", "height", "params"}``.

        COLMAP puts the centre of the top-left pixel at (0.5, 0.5), so its principal point is
        (``cx`` + 0.5, ``cy`` + 0.5). An unknown focal length is None, ``null`` in JSON.

        Examples
        --------
        >>> from cadalign import Camera
        >>> Camera(640, 480, 500, 500, 319.5, 239.5).to_dict()["params"]
        [500.0, 500.0, 320.0, 240.0]
        """
        if self.turn:
            what = "a camera with a turned frame cannot be written"
            raise InputError(what, where="camera", fix="write the camera before it was turned")
        model = _MODELS.get(len(self.distortion), "FULL_OPENCV")
        model = "OPENCV_FISHEYE" if self.lens == "fisheye" else model
        names = _COEFFICIENTS[self.lens]
        values: dict[str, float | None] = dict(zip(names, self.distortion, strict=False))
        values |= {"cx": self.cx + PIXEL_CENTRE, "cy": self.cy + PIXEL_CENTRE}
        values |= {name: getattr(self, name) if self.focal_known else None for name in ("fx", "fy")}
        return {
            "model": model,
            "width": self.width,
            "height": self.height,
            "params": [values.get(name, 0.0) for name in COLMAP_PARAMS[model]],
        }

    @classmethod
    def from_dict(cls: type[_C], data: Mapping[str, Any]) -> _C:
        """Read a camera from COLMAP's form or from a calibration matrix.

        Parameters
        ----------
        data : mapping
            COLMAP's form, see `to_dict`: ``model`` (SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL,
            OPENCV, FULL_OPENCV or OPENCV_FISHEYE), ``width``, ``height``, and ``params`` in
            COLMAP's order. With None as focal lengths, or with ``width`` and ``height`` alone, the
            camera is made by `from_size`. The other form: ``matrix`` (3, 3), ``width``,
            ``height`` and optionally ``distortion`` and ``lens``, see `from_matrix`. Both forms
            accept ``pixel_origin``, by default ``"corner"`` with ``params`` and ``"center"`` with
            ``matrix``.

        Raises
        ------
        InputError
            If a field is missing, the model is unknown, or the number of parameters is wrong.

        Examples
        --------
        >>> from cadalign import Camera
        >>> Camera.from_dict({"model": "SIMPLE_RADIAL", "width": 640, "height": 480,
        ...                   "params": [500, 320, 240, 0.1]}).distortion
        (0.1, 0.0, 0.0, 0.0)
        >>> matrix = [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]
        >>> Camera.from_dict({"matrix": matrix, "width": 640, "height": 480}).cx
        319.5
        """
        if not isinstance(data, Mapping):
            raise InputError(f"expected an object, got {type(data).__name__}", where="camera")
        if set(data) - {"pixel_origin"} == {"width", "height"}:
            return cls.from_size(data["width"], data["height"])
        kind = "matrix" if "matrix" in data and "params" not in data else "params"
        missing = [key for key in _FORMS[kind] if key not in data]
        if missing:
            names = ", ".join(f'"{name}"' for name in _FORMS[kind])
            fix = f"give {{{names}}}" + (" as COLMAP does" if kind == "params" else "")
            fix += ", or width and height alone if the focal length is unknown"
            raise InputError(f"missing {', '.join(missing)}", where="camera", fix=fix)
        given = {name: data[name] for name in _MATRIX_FIELDS if name in data}
        if kind == "matrix":
            return cls.from_matrix(**given)
        shift = shift_of(data.get("pixel_origin", "corner"), where="camera.pixel_origin")
        fields = _read_params(data["model"], data["params"], shift)
        make = cls if "fx" in fields else cls.from_size
        return make(width=data["width"], height=data["height"], **fields)


def _as_coefficients(distortion: Any) -> tuple[float, ...]:
    """Convert distortion coefficients to a tuple; OpenCV's have the shapes (1, n) and (n, 1)."""
    try:
        if np.iscomplexobj(distortion) or is_masked(distortion):
            raise TypeError
        if np.ndim(distortion) == 2 and 1 in np.shape(distortion):
            distortion = np.ravel(distortion)
        return tuple(float(value) for value in distortion)
    except (TypeError, ValueError, OverflowError, NotImplementedError):  # the last: memoryview
        raise InputError("not a sequence of numbers", where="camera.distortion") from None


def _whole_size(size: Any, name: str) -> int:
    if not is_number(size) or int(size) != size or size < 1:
        what, fix = f"{quote(size)} is not a size", "give the image size in whole pixels"
        raise InputError(what, where=f"camera.{name}", fix=fix)
    return int(size)


def _read_params(model: Any, params: Any, shift: float) -> dict[str, Any]:
    """Read COLMAP's parameters; ``shift`` is the coordinate of the top-left pixel's centre."""
    if not isinstance(model, str) or model not in COLMAP_PARAMS:
        fix = f"known are {', '.join(COLMAP_PARAMS)}; for others undistort the images"
        raise InputError(f"unknown model {quote(model)}", where="camera.model", fix=fix)
    names = COLMAP_PARAMS[model]
    params = params.tolist() if isinstance(params, np.ndarray) else params
    if not isinstance(params, list | tuple) or len(params) != len(names):
        what, fix = f"{quote(params)} are not the parameters of {model}", f"give {', '.join(names)}"
        raise InputError(what, where="camera.params", fix=fix)
    values = dict(zip(names, params, strict=True))
    focals = [name for name in names if name.startswith("f")]
    is_known = any(values[name] is not None for name in focals)
    for name, value in values.items():
        if not is_number(value) and (is_known or name not in focals):
            what = f"{name} is {quote(value)}, not a finite number"
            raise InputError(what, where="camera.params")
    lens: LensKind = "fisheye" if model.endswith("FISHEYE") else "perspective"
    distortion = tuple(values.get(name, 0.0) for name in _COEFFICIENTS[lens])
    distortion = distortion if any(distortion[4:]) else distortion[:4]
    fields = {"cx": values["cx"] - shift, "cy": values["cy"] - shift, "distortion": distortion}
    if is_known:
        return fields | {"fx": values[focals[0]], "fy": values[focals[-1]], "lens": lens}
    require_perspective_lens(lens, where="camera.params")
    return fields


@lru_cache(maxsize=64)  # many estimates share a camera
@np.errstate(over="ignore")  # image sizes are unbounded
def camera_doubts(camera: Calibration, *, is_tested: bool = False) -> tuple[str, ...]:
    """Sentences about implausible parameters of a camera, usually none.

    ``is_tested`` states that keypoints agree with the camera, which confirms a short focal length.
    """
    found, focal = [], np.array([camera.fx, camera.fy])
    own = np.array([camera.width, camera.height], dtype=float)
    size = f"{camera.width} x {camera.height} px"
    point = f"the camera's principal point ({camera.cx:.4g}, {camera.cy:.4g}) is"
    sizes, middle = np.outer(OTHER_SIZES, own), np.array([camera.cx, camera.cy]) + PIXEL_CENTRE
    same = np.flatnonzero(np.abs(2 * middle / sizes - 1).max(axis=1) < _SAME_MIDDLE).tolist()
    if same:
        width, height = sizes[same[0]]
        found.append(
            f"{point} the middle of an image of {width:.0f} x {height:.0f} px, but the image "
            f"has {size}: if the photo was resized, give its original camera.resize("
            f"{camera.width}, {camera.height})"
        )
    elif np.abs(middle / own - 0.5).max() >= _FAR_FROM_MIDDLE:
        found.append(
            f"{point} far from the middle of the image of {size}: this is right only for a "
            "photo cropped from a larger one"
        )
    if not 1 / _OBLONG < camera.fx / camera.fy < _OBLONG:
        found.append(
            f"the camera's pixels are oblong (fx {camera.fx:.4g}, fy {camera.fy:.4g}): was the "
            "photo squeezed?"
        )
    angle = 2 * math.degrees(math.atan(float((own / focal).max()) / 2))
    is_pinhole = camera.lens == "perspective" and not any(camera.distortion)
    if camera.focal_known and is_pinhole and angle > _WIDEST_DEG and not is_tested:
        found.append(
            f"the camera sees {angle:.0f} deg without a lens model: is the focal length, "
            f"{focal.min():.4g}, in pixels?"
        )
    return tuple(found)
