"""Matplotlib axes in the pixels of a photo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GREY = 0.9


def photo_axes(
    width: int, height: int, image: npt.ArrayLike | None = None, *, axes: Axes | None = None
) -> Axes:
    """Draw a photo (h, w[, 3]) of a camera with so many pixels, or grey where there is none.

    Returns axes in its pixels: the given ones, or those of a new figure.

    Raises
    ------
    InputError
        If the photo is not of the camera's size.
    """
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(figsize=(8, 8 * height / width))[1]
    pixels = np.full((1, 1, 3), _GREY) if image is None else np.asarray(image)
    if image is not None and pixels.shape[:2] != (height, width):
        raise InputError(
            f"shape {pixels.shape}, but the camera has {width} x {height} pixels",
            where="image",
            fix="give the photo of this camera",
        )
    axes.imshow(
        pixels,
        cmap="gray",
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        interpolation="antialiased",
    )
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_axis_off()
    return axes
