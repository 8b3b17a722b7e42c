"""Cameras that are hardly right: of another image, with oblong pixels, or with a tiny focal length.

Whoever reads, takes or shows a camera asks this one function.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from cadalign.geometry.calibration import Calibration
from cadalign.geometry.pixels import PIXEL_CENTRE

OTHER_SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
"""Usual sizes of other images of a photo, over that of its camera."""
_FAR_FROM_MIDDLE = 0.3  # of an image's size, from its middle to a principal point
_SAME_MIDDLE = 0.02  # of an image's size, from its middle to a principal point taken for it
_OBLONG = 1.1  # ratio of a pixel's sides
_WIDEST_DEG = 120.0  # angle of view of a camera without a lens model


@lru_cache(maxsize=64)  # most estimates have the camera of others
@np.errstate(over="ignore")  # sizes of images are any numbers
def camera_doubts(camera: Calibration, *, is_tested: bool = False) -> tuple[str, ...]:
    """Say what is implausible of a camera, a sentence each; nothing of most.

    Parameters
    ----------
    camera : Camera
    is_tested : bool
        Keypoints that agree with a wide camera confirm its focal length.
    """
    found, own = [], np.array([camera.width, camera.height], dtype=float)
    size = f"{camera.width} x {camera.height} px"
    point = f"the camera's principal point ({camera.cx:.4g}, {camera.cy:.4g}) is"
    sizes, middle = np.outer(OTHER_SIZES, own), np.array([camera.cx, camera.cy]) + PIXEL_CENTRE
    same = np.flatnonzero(np.abs(2 * middle / sizes - 1).max(axis=1) < _SAME_MIDDLE).tolist()
    if same:
        width, height = sizes[same[0]]
        found.append(
            f"{point} the middle of an image of {width:.0f} x {height:.0f} px, its own has "
            f"{size}: if the photo was resized, give Camera.resized({camera.width}, "
            f"{camera.height}) of its camera"
        )
    elif np.abs(middle / own - 0.5).max() >= _FAR_FROM_MIDDLE:
        found.append(
            f"{point} far from the middle of its image of {size}, which is right "
            "only for a photo cut out of a larger one"
        )
    focal = np.array([camera.fx, camera.fy])
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
