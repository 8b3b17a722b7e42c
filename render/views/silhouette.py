"""Agreement of two silhouettes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError


def silhouette_iou(*, est: npt.ArrayLike, gt: npt.ArrayLike) -> float:
    """Intersection over union of the predicted and the observed object's pixels.

    Parameters
    ----------
    est, gt : (h, w) bool
        Where each is, for example `Geometry.mask`; of numbers, what is above half of the largest
        possible value (1 for floats, 255 for bytes) counts, so that opacities will do.

    Returns
    -------
    float
        From 0 to 1; NaN where neither is anywhere.

    Raises
    ------
    InputError
        If they are not images of one size.

    Examples
    --------
    >>> silhouette_iou(est=[[True, True, False]], gt=[[False, True, True]])
    0.3333333333333333
    """
    one, other = _as_mask(est, "est"), _as_mask(gt, "gt")
    if one.shape != other.shape:
        raise InputError(f"shape {one.shape}, but gt has {other.shape}", where="est")
    union = int((one | other).sum())
    return int((one & other).sum()) / union if union else float("nan")


def _as_mask(value: npt.ArrayLike, name: str) -> npt.NDArray[np.bool_]:
    array = np.asarray(value)
    if array.ndim != 2 or array.dtype.kind not in "buif":
        raise InputError(f"shape {array.shape}, expected (h, w) of truth values", where=name)
    if array.dtype.kind == "b":
        return array.astype(bool)
    full = 1.0 if array.dtype.kind == "f" else float(np.iinfo(array.dtype).max)
    return np.asarray(array > full / 2)
