"""Files of one camera: a calibration matrix as text, NumPy array or JSON, or COLMAP's form."""

from __future__ import annotations

import io
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.errors import DataError, brief
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PixelOrigin
from cadalign.io.documents import in_file, read_json
from cadalign.io.files import as_path, read_bytes, read_text

_ARRAY = ".npy"
_MOST_BYTES = 2**20  # of an array, which has nine numbers
_MATRIX_NAMES = ("matrix", "K", "camera_matrix", "cam_K")
_FIX = "give 3 x 3 numbers, or a JSON file with model, width, height and params as COLMAP does"


def read_camera(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    pixel_origin: PixelOrigin | None = None,
) -> Camera:
    """Read a camera from a file.

    Parameters
    ----------
    path : path-like
        A calibration matrix K: text of 3 x 3 numbers, a ``.npy`` array, or JSON, bare or as
        ``matrix`` (also ``K``, ``camera_matrix``, ``cam_K``), by rows; or a camera in the form of
        `Camera.from_dict` as JSON.
    size : tuple of 2 int, optional
        Width and height of the photo [px], for a matrix whose file lacks them.
    pixel_origin : {"center", "corner"}, optional
        Where (0, 0) lies for the principal point; by default what the file states, or else the
        centre for a matrix and the corner for COLMAP's form.

    Raises
    ------
    DataError
        If the file cannot be read, holds no camera, or lacks the image's size.
    """
    path = as_path(path)
    form = _read_form(path)
    if pixel_origin is not None:
        form["pixel_origin"] = pixel_origin
    if "matrix" in form and not {"width", "height"} <= set(form):
        if size is None:
            what = "the file has a matrix alone, and the size of the image is unknown"
            raise DataError(what, where=str(path), fix="give the photo, or width and height in it")
        form |= {"width": size[0], "height": size[1]}
    with in_file(path):
        return Camera.from_dict(form)


def _read_form(path: Path) -> dict[str, Any]:
    """The parsed form of a camera in a file."""
    if path.suffix.lower() == _ARRAY:
        return {"matrix": _read_array(path)}
    if not _is_json(path):
        numbers = read_text(path).replace(",", " ").replace(";", " ").split()
        return {"matrix": _square(numbers, path)}
    data = read_json(path)
    if isinstance(data, list) and len(data) in (3, 9):
        return {"matrix": _square(data, path)}
    if not isinstance(data, dict):
        what = f"camera: expected an object, got {type(data).__name__}"
        raise DataError(what, where=str(path), fix=_FIX)
    for name in _MATRIX_NAMES:
        if name in data and "params" not in data:
            rest = {key: value for key, value in data.items() if key != name}
            return {**rest, "matrix": _square(data[name], path)}
    return dict(data)


def _is_json(path: Path) -> bool:
    text = read_text(path)
    return path.suffix.lower() == ".json" or text.lstrip()[:1] in ("{", "[")


def _read_array(path: Path) -> Any:
    file = io.BytesIO(read_bytes(path, most=_MOST_BYTES))
    try:
        with warnings.catch_warnings(action="ignore"):
            values = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # NumPy has Python parse the header, which raises what it likes
        what = f"not a NumPy array that can be read ({brief(error)})"
        raise DataError(what, where=str(path)) from None
    return _square(values, path)


def _square(values: Any, path: Path) -> Any:
    """A matrix (3, 3) of nine numbers by rows, however they are nested."""
    try:
        return np.asarray(values, dtype=float).reshape(3, 3)
    except (TypeError, ValueError, OverflowError):
        raise DataError("not a calibration matrix", where=str(path), fix=_FIX) from None
