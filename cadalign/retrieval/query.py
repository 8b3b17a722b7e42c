"""Reading of queries: observations whose keypoints need no model points, masks and opacity."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import in_file
from cadalign.io.images import open_photo, read_image
from cadalign.io.observation import Observation
from cadalign.render.drawing.color import ByteImage


def read_query(path: Path) -> Observation:
    """Read an observation file for retrieval.

    The format is that of `cadalign.io.observation`, but keypoints must have a ``semantic_id`` and
    may lack ``xyz``, which is zero in the returned observation and not used.
    """
    query = Observation.load(path, needs_xyz=False)
    with in_file(path):
        if query.semantic_ids is None:
            raise DataError(
                "the keypoints have no semantic_id",
                fix="give each the id of the library's models for it",
            )
    return query


def read_mask(path: Path, camera: Camera) -> BoolArray:
    """Read an image whose bright pixels are the object's, (h, w) bool; raises as `read_image`."""
    return np.asarray(read_image(path, camera).mean(axis=2) > 127.5)


def read_opacity(path: Path | None, camera: Camera) -> ByteImage:
    """Read a photo with its opacity if it has one, (h, w, 3 or 4) uint8, upright by EXIF."""
    if path is None:
        raise InputError(
            "the observation names no image",
            where="--silhouette",
            fix="add the image to the observation, or give the object's pixels with --mask",
        )
    colors = read_image(path, camera)
    from PIL import ImageOps

    with open_photo(path) as image:
        if not image.has_transparency_data:
            return colors
        # The transparent colour of a palette is no separate channel in the file.
        opacity = ImageOps.exif_transpose(image).convert("RGBA").getchannel("A")
        return np.dstack([colors, np.asarray(opacity)])
