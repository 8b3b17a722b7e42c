"""Keypoints and a principal point that are none of the image's."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE

OTHER_SIZES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
"""Usual sizes of other images of a photo, over that of its camera."""
_SAME_MIDDLE = 0.02  # of an image's size, from its middle to a principal point taken for it


def outside_image(
    points_2d: FloatArray, camera: Camera, *, agree: bool, view: int = 0, where: str = ""
) -> Warnings:
    """Warn about keypoints (n, 2) and a principal point that are none of the image's.

    ``view`` is the number of the view, ``where`` what the texts begin with.

    All keypoints lie beyond one side, or, where they do not ``agree``, most outside: of an object
    that is hidden or cropped, some may, and they may surround the image.
    """
    wrong = _wrong_principal_point(camera)
    doubts = () if wrong is None else (EstimateWarning("camera", where + wrong, view),)
    outside = np.flatnonzero(~camera.contains(points_2d)).tolist()
    count = len(outside)
    if 2 * count <= len(points_2d):
        return doubts
    last = np.array([camera.width, camera.height]) - PIXEL_CENTRE
    beyond = (points_2d < -PIXEL_CENTRE).all(axis=0) | (points_2d > last).all(axis=0)
    if agree and not beyond.any():
        return doubts
    text = (
        f"{where}{count} of {len(points_2d)} keypoints lie outside of the image of {camera.width} "
        f"x {camera.height} px: are they of another resolution than the camera, or of another "
        "photo?"
    )
    return (*doubts, EstimateWarning("outside-image", text, view, tuple(outside)))


def _wrong_principal_point(camera: Camera) -> str | None:
    """Says that a principal point is the middle of another image, or outside of its own."""
    if camera.is_centred:
        return None
    size, own = f"{camera.width} x {camera.height} px", f"({camera.cx:.4g}, {camera.cy:.4g})"
    middle = 2 * (camera.cx + PIXEL_CENTRE), 2 * (camera.cy + PIXEL_CENTRE)
    for factor in OTHER_SIZES:
        other = camera.width * factor, camera.height * factor
        apart = (abs(a - b) / b for a, b in zip(middle, other, strict=True))
        if max(apart) < _SAME_MIDDLE:
            return (
                f"the camera's principal point {own} is the middle of an image of "
                f"{other[0]:.0f} x {other[1]:.0f} px, its own has {size}: if the photo was resized "
                f"(not cut out), give Camera.resized({camera.width}, {camera.height}) of the "
                "camera of that size"
            )
    if camera.contains(np.array([[camera.cx, camera.cy]])).all():
        return None
    return (
        f"the camera's principal point {own} lies outside of its image of {size}, which is right "
        "only for a photo cut out of a larger one: compare the camera with the photo's size"
    )
