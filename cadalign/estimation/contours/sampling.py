"""Values of images between their pixels.

OpenCV 4 rounds places to 1/32 px (`cv2.remap`, `cv2.warpAffine`), which moves contours by more than
the precision that is sought.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.compile import kernel
from cadalign.io.images import ByteImage

Image = npt.NDArray[np.float32]


def sampled(image: Image, points: FloatArray) -> FloatArray:
    """Values (n,) of an image (h, w) at points (n, 2), bilinear; outside those of the border."""
    return np.asarray(_bilinear(image[..., None], np.ascontiguousarray(points))[:, 0])


def colors_at(photo: ByteImage, points: FloatArray) -> ByteImage:
    """Colours (n, c) of a photo (h, w, c) at points (n, 2), as `sampled`."""
    return np.rint(_bilinear(photo, np.ascontiguousarray(points))).astype(np.uint8)


@kernel
def _bilinear(image: npt.NDArray[np.generic], points: FloatArray) -> FloatArray:
    height, width, channels = image.shape
    found = np.empty((len(points), channels))
    for row in range(len(points)):
        x, y = points[row, 0], points[row, 1]
        x = min(x, width - 1.0) if x > 0.0 else 0.0  # also where it is no number
        y = min(y, height - 1.0) if y > 0.0 else 0.0
        left, top = int(x), int(y)
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        x -= left
        y -= top
        for k in range(channels):
            upper_left, upper_right = float(image[top, left, k]), float(image[top, right, k])
            lower_left, lower_right = float(image[bottom, left, k]), float(image[bottom, right, k])
            upper = upper_left + x * (upper_right - upper_left)
            lower = lower_left + x * (lower_right - lower_left)
            found[row, k] = upper + y * (lower - upper)
    return found
