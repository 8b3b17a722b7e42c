"""Corners in a photo, to which clicks snap."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.annotate.document import Pixel

_MARGIN = 8  # around the reach, for the derivatives [px]
_QUALITY = 0.3  # of a corner, over that of the best within reach
_CONTRAST = 3.0  # least standard deviation of grey values within reach
_WINDOW = 3
_DRIFT = 4.0  # that the refinement may move a corner [px]


def nearest_corner(image: npt.NDArray[np.uint8], uv: Pixel, *, reach: float) -> Pixel | None:
    """The nearest corner of a photo (h, w, 3) within ``reach`` [px], to parts of a pixel.

    Shi, Tomasi, "Good features to track" (1994), refined by the gradients about it. None without
    one.

    Examples
    --------
    >>> photo = np.zeros((40, 40, 3), dtype=np.uint8)
    >>> photo[20:, 20:] = 255
    >>> u, v = nearest_corner(photo, (22.0, 18.0), reach=6)
    >>> abs(u - 19.5) < 0.6, abs(v - 19.5) < 0.6
    (True, True)
    """
    height, width = image.shape[:2]
    size = int(np.ceil(reach)) + _MARGIN
    left, top = max(0, round(uv[0]) - size), max(0, round(uv[1]) - size)
    right, bottom = min(width, round(uv[0]) + size + 1), min(height, round(uv[1]) + size + 1)
    patch = cv2.cvtColor(np.ascontiguousarray(image[top:bottom, left:right]), cv2.COLOR_RGB2GRAY)
    rows, columns = np.indices(patch.shape)
    inside = np.hypot(columns + left - uv[0], rows + top - uv[1]) <= reach
    if not inside.any() or np.std(patch[inside]) < _CONTRAST:
        return None
    mask = np.where(inside, 255, 0).astype(np.uint8)
    found = cv2.goodFeaturesToTrack(patch, 16, _QUALITY, 3.0, mask=mask)
    if found is None:
        return None  # type: ignore[unreachable]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    refined = cv2.cornerSubPix(patch, found.copy(), (_WINDOW, _WINDOW), (-1, -1), stop)
    drift = np.linalg.norm(refined - found, axis=2)
    places = np.where(drift[..., None] <= _DRIFT, refined, found)[:, 0] + (left, top)
    gaps = np.linalg.norm(places - uv, axis=1)
    u, v = places[int(np.argmin(gaps))].tolist()
    return min(max(u, -0.5), width - 0.5), min(max(v, -0.5), height - 0.5)
