"""Reading the pictures that silhouettes are taken from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera
from cadalign.io.images import open_photo, read_image
from cadalign.render.drawing.color import ByteImage


def read_mask(path: Path, camera: Camera) -> BoolArray:
    """Read a picture whose bright pixels are the object's, (h, w) bool.

    Raises
    ------
    DataError
        If it is missing, is not an image, or has another size than the camera.
    """
    return np.asarray(read_image(path, camera).mean(axis=2) > 127.5)


def read_opacity(path: Path | None, camera: Camera) -> ByteImage:
    """Read a photo with its opacity if it has one, (h, w, 3 or 4) uint8, upright by EXIF.

    Raises
    ------
    InputError
        If the observation names no image.
    DataError
        If it is missing, is not an image, or has another size than the camera.
    """
    if path is None:
        raise InputError(
            "the observation names no image",
            where="--silhouette",
            fix="give its image, or the object's pixels with --mask",
        )
    colors = read_image(path, camera)
    from PIL import ImageOps

    with open_photo(path) as image:
        if not image.has_transparency_data:
            return colors
        # A transparent colour, as of a palette, is no channel of its own in the file.
        opacity = ImageOps.exif_transpose(image).convert("RGBA").getchannel("A")
        return np.dstack([colors, np.asarray(opacity)])
