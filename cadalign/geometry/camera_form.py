"""The form of cameras in JSON: COLMAP's models and parameters, or a calibration matrix."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from cadalign.arrays import as_floats, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.pixels import LensKind, PixelOrigin, shift_of

# COLMAP's camera models: the names of their parameters, in COLMAP's order.
COLMAP_PARAMS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    ),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
}
_DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# Written models of lenses, by kind and number of coefficients.
_WRITTEN: dict[tuple[LensKind, int], str] = {
    ("perspective", 0): "PINHOLE",
    ("perspective", 4): "OPENCV",
    ("fisheye", 4): "OPENCV_FISHEYE",
    ("fisheye", 8): "THIN_PRISM_FISHEYE",
    ("fov", 1): "FOV",
}
_NO_SKEW = 1e-9  # relative to the focal length
_FORM_FIX = 'give {"model", "width", "height", "params"} as COLMAP does'


class CameraForm(NamedTuple):
    """The fields of a camera, its principal point with integers at pixel centres.

    ``center`` is (None, None) for the image's centre and ``focals`` None where unknown. Where
    ``matrix`` is given, its principal point counts from ``pixel_origin``.
    """

    size: tuple[Any, Any]
    focals: tuple[float, float] | None = None
    center: tuple[Any, Any] = (None, None)
    distortion: tuple[float, ...] = ()
    lens: LensKind = "perspective"
    matrix: Any = None
    pixel_origin: PixelOrigin = "center"


def write_form(form: CameraForm, pixel_origin: PixelOrigin | None) -> dict[str, Any]:
    """A camera in COLMAP's form; see `Camera.to_dict`."""
    model = _WRITTEN.get((form.lens, len(form.distortion)), "FULL_OPENCV")
    shift = shift_of(pixel_origin or "corner")
    names = COLMAP_PARAMS[model][4:] if form.lens != "perspective" else _DISTORTION_NAMES
    values: dict[str, float | None]
    values = dict(zip(names, form.distortion, strict=False))
    values |= dict(zip(("fx", "fy"), form.focals or (None, None), strict=True))
    values |= {"cx": form.center[0] + shift, "cy": form.center[1] + shift}
    return {
        "model": model,
        "width": form.size[0],
        "height": form.size[1],
        "params": [values.get(name, 0.0) for name in COLMAP_PARAMS[model]],
    }


def read_matrix(matrix: Any, pixel_origin: object) -> tuple[float, float, float, float]:
    """Focal lengths and principal point (fx, fy, cx, cy) of a matrix; see `Camera.from_matrix`."""
    shift = shift_of(pixel_origin)
    values = as_floats(matrix, name="matrix", shape=(3, 3))
    (fx, _, cx), (_, fy, cy), _ = values.tolist()
    expected = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if np.abs(values - expected).max() > _NO_SKEW * max(abs(fx), 1.0):
        raise InputError(
            f"{quote(values.tolist())} is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            where="matrix",
            fix="give the matrix of a camera without skew, by rows",
        )
    return fx, fy, cx - shift, cy - shift


def read_form(data: Any) -> CameraForm:
    """Read the fields of a camera; see `Camera.from_dict`."""
    if not isinstance(data, Mapping):
        raise InputError(f"expected an object, got {type(data).__name__}", where="camera")
    if set(data) - {"pixel_origin"} == {"width", "height"}:
        return CameraForm((data["width"], data["height"]))
    is_matrix = "matrix" in data and "params" not in data
    names = ("matrix", "width", "height") if is_matrix else ("model", "width", "height", "params")
    missing = [key for key in names if key not in data]
    if missing:
        fix = 'give {"matrix", "width", "height"}' if is_matrix else _FORM_FIX
        raise InputError(f"missing {', '.join(missing)}", where="camera", fix=fix)
    size = data["width"], data["height"]
    origin = data.get("pixel_origin", "center" if is_matrix else "corner")
    shift = shift_of(origin, where="camera.pixel_origin")
    if is_matrix:
        return CameraForm(
            size,
            matrix=data["matrix"],
            distortion=data.get("distortion", ()),
            lens=data.get("lens", "perspective"),
            pixel_origin=cast(PixelOrigin, origin),
        )
    return _read_params(data["model"], data["params"], size, shift)


def _read_params(model: Any, params: Any, size: tuple[Any, Any], shift: float) -> CameraForm:
    """Read COLMAP's parameters, whose top-left pixel has its centre at ``shift``."""
    if not isinstance(model, str) or model not in COLMAP_PARAMS:
        known = ", ".join(COLMAP_PARAMS)
        raise InputError(
            f"unknown model {quote(model)}", where="camera.model", fix=f"known are {known}"
        )
    names = COLMAP_PARAMS[model]
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
    lens, distortion = _lens_of(model, values)
    return CameraForm(
        size,
        focals=(values[focals[0]], values[focals[-1]]) if is_known else None,
        center=(values["cx"] - shift, values["cy"] - shift),
        distortion=distortion,
        lens=lens,
    )


def _lens_of(model: str, values: Mapping[str, float]) -> tuple[LensKind, tuple[float, ...]]:
    """Kind and coefficients of a model's lens."""
    if model == "FOV":
        return "fov", (values["omega"],)
    if model == "THIN_PRISM_FISHEYE":
        return "fisheye", tuple(values[name] for name in COLMAP_PARAMS[model][4:])
    if model.endswith("FISHEYE"):
        return "fisheye", tuple(values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))
    coefficients = tuple(values.get(name, 0.0) for name in _DISTORTION_NAMES)
    return "perspective", coefficients if any(coefficients[4:]) else coefficients[:4]
