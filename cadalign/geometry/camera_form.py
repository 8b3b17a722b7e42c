"""The form of cameras in JSON: COLMAP's models and parameters, or a calibration matrix."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cadalign.arrays import as_floats, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.pixels import LensKind, PixelOrigin, require_perspective_lens, shift_of

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


def write_form(fields: Mapping[str, Any], pixel_origin: PixelOrigin | None) -> dict[str, Any]:
    """COLMAP's form of a camera with these fields; see `Camera.to_dict`."""
    lens, distortion = fields["lens"], fields["distortion"]
    model = _WRITTEN.get((lens, len(distortion)), "FULL_OPENCV")
    shift = shift_of(pixel_origin or "corner")
    names = _DISTORTION_NAMES if lens == "perspective" else COLMAP_PARAMS[model][4:]
    focals = (fields["fx"], fields["fy"]) if fields["focal_known"] else (None, None)
    values: dict[str, float | None] = dict(zip(names, distortion, strict=False))
    numbers = (*focals, fields["cx"] + shift, fields["cy"] + shift)
    values |= zip(("fx", "fy", "cx", "cy"), numbers, strict=True)
    form = {
        "model": model,
        "width": fields["width"],
        "height": fields["height"],
        "params": [values.get(name, 0.0) for name in COLMAP_PARAMS[model]],
    }
    return form if pixel_origin is None else form | {"pixel_origin": pixel_origin}


def read_matrix(matrix: Any, pixel_origin: object) -> tuple[float, float, float, float]:
    """Focal lengths and principal point (fx, fy, cx, cy) of a matrix; see `Camera.from_matrix`."""
    shift = shift_of(pixel_origin)
    values = as_floats(matrix, name="matrix", shape=(3, 3))
    (fx, _, cx), (_, fy, cy), _ = values.tolist()
    expected = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if np.abs(values - expected).max() > _NO_SKEW * max(abs(fx), 1.0):
        form = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        fix = "give the matrix of a camera without skew, by rows"
        raise InputError(
            f"{quote(values.tolist())} is not of the form {form}", where="matrix", fix=fix
        )
    return fx, fy, cx - shift, cy - shift


def read_form(data: Any) -> dict[str, Any]:
    """Read the fields of a camera, without the focal lengths where these are unknown.

    They are arguments of `Camera`, or of `Camera.without_focal`; see `Camera.from_dict`.
    """
    if not isinstance(data, Mapping):
        raise InputError(f"expected an object, got {type(data).__name__}", where="camera")
    if set(data) - {"pixel_origin"} == {"width", "height"}:
        return {"width": data["width"], "height": data["height"]}
    is_matrix = "matrix" in data and "params" not in data
    names = ("matrix", "width", "height") if is_matrix else ("model", "width", "height", "params")
    missing = [key for key in names if key not in data]
    if missing:
        fix = 'give {"matrix", "width", "height"}' if is_matrix else _FORM_FIX
        raise InputError(f"missing {', '.join(missing)}", where="camera", fix=fix)
    fields = {"width": data["width"], "height": data["height"]}
    origin = data.get("pixel_origin", "center" if is_matrix else "corner")
    shift = shift_of(origin, where="camera.pixel_origin")
    if not is_matrix:
        return fields | _read_params(data["model"], data["params"], shift)
    fields |= zip(("fx", "fy", "cx", "cy"), read_matrix(data["matrix"], origin), strict=True)
    lens = data.get("lens", "perspective")
    return fields | {"distortion": data.get("distortion", ()), "lens": lens}


def _read_params(model: Any, params: Any, shift: float) -> dict[str, Any]:
    """Read COLMAP's parameters, whose top-left pixel has its centre at ``shift``."""
    if not isinstance(model, str) or model not in COLMAP_PARAMS:
        fix = f"known are {', '.join(COLMAP_PARAMS)}"
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
    lens, distortion = _lens_of(model, values)
    fields = {"cx": values["cx"] - shift, "cy": values["cy"] - shift, "distortion": distortion}
    if is_known:
        return fields | {"fx": values[focals[0]], "fy": values[focals[-1]], "lens": lens}
    require_perspective_lens(lens, where="camera.params")
    return fields


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
