"""Checked channels of a view: depths, masks, and the deviation of a direction."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats, as_positive, is_number
from cadalign.errors import InputError, quote
from cadalign.geometry.camera import Camera
from cadalign.io.images import read_grey

_FILE_SCALE = 0.001  # of a 16-bit depth image: millimetres to metres
_SYMMETRY_TOLERANCE = 1e-9


def checked_depth(given: Any, camera: Camera, count: int, scale: float | None) -> FloatArray:
    """Depths of the keypoints (n,), or a depth image (h, w); NaN where unknown.

    Raises
    ------
    InputError
        If it has neither shape, or a depth is negative.
    """
    factor = None if scale is None else as_positive(scale, name="depth_scale")
    if isinstance(given, str | os.PathLike):
        depth = read_grey(Path(given)).astype(np.float64)
        factor = _FILE_SCALE if factor is None else factor
    else:
        depth = np.asarray(given)
        if depth.ndim == 2 and depth.dtype.kind in "iu" and factor is None:
            fix = "give `depth_scale`, 0.001 for millimetres where metres are wanted"
            raise InputError("whole numbers have no unit", where="depth", fix=fix)
        shape = (None,) if depth.ndim == 1 else (None, None)
        depth = as_floats(depth, name="depth", shape=shape, finite=False)
    wanted = (count,) if depth.ndim == 1 else (camera.height, camera.width)
    if depth.shape != wanted:
        what = f"shape {depth.shape}, expected ({count},) or ({camera.height}, {camera.width})"
        fix = "give a depth per keypoint, or a depth image of the camera's size"
        raise InputError(what, where="depth", fix=fix)
    known = np.isfinite(depth)
    if depth.ndim == 1:
        bad = (depth[known] <= 0).any()
    else:
        known &= depth != 0
        bad = (depth[known] < 0).any()
    if bad:
        fix = "give NaN where it is unknown"
        raise InputError("has values that are not positive", where="depth", fix=fix)
    return np.where(known, depth * (1.0 if factor is None else factor), np.nan)


def checked_depth_sigma(sigma: npt.ArrayLike, depth: object, count: int) -> None:
    """Check the relative deviation of depths.

    Raises
    ------
    InputError
        If it is not positive, or neither one nor one per depth.
    """
    relative = np.asarray(sigma, dtype=np.float64)
    shapes = [()] if isinstance(depth, np.ndarray) and depth.ndim == 2 else [(), (count,)]
    if relative.shape not in shapes or not (relative > 0).all():
        raise InputError("must be positive, one or one per keypoint", where="depth_sigma")


def checked_mask(given: Any, camera: Camera) -> FloatArray | BoolArray:
    """A mask (h, w): bool, or probabilities.

    Raises
    ------
    InputError
        If it has another size than the camera, or holds other values.
    """
    is_file = isinstance(given, str | os.PathLike)
    mask = read_grey(Path(given)) != 0 if is_file else np.asarray(given)
    if mask.shape != (camera.height, camera.width):
        size = " x ".join(str(length) for length in mask.shape[::-1])
        what = f"the mask is {size or 'a number'}, the camera {camera.width} x {camera.height}"
        raise InputError(what, where="mask", fix="give the mask of this image, in its size")
    if mask.dtype == bool:
        return mask
    probabilities = as_floats(mask, name="mask", shape=(None, None))
    if probabilities.min() < 0 or probabilities.max() > 1:
        fix = "give a bool array, or probabilities; of an image of bytes give `image > 0`"
        raise InputError("has values outside of [0, 1]", where="mask", fix=fix)
    return probabilities


def checked_up_sigma(sigma: Any) -> None:
    """Check the deviation of a direction, or its covariance (3, 3).

    Raises
    ------
    InputError
        If it is neither positive nor a covariance.
    """
    if np.ndim(sigma) == 0:
        if not is_number(sigma) or not sigma > 0:
            raise InputError(f"{quote(sigma)} is not positive", where="up_sigma_deg")
        return
    covariance = as_floats(sigma, name="up_sigma_deg", shape=(3, 3))
    size = np.abs(covariance).max()
    values = np.linalg.eigvalsh(covariance)
    is_symmetric = np.abs(covariance - covariance.T).max() <= _SYMMETRY_TOLERANCE * size
    if not is_symmetric or values[0] < -_SYMMETRY_TOLERANCE * size or not values[1] > 0:
        what = "not a covariance of rank 2 or more"
        fix = "give a positive number [degrees], or the covariance of the direction"
        raise InputError(what, where="up_sigma_deg", fix=fix)
