"""Results as the aligned objects that `cadalign.export` writes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.result_data import ResultData
from cadalign.estimation.result_parts import ViewResult
from cadalign.export.aligned_object import AlignedObject, ExportView
from cadalign.geometry.mesh import Mesh
from cadalign.io.images import ByteImage

Photo = Path | str | ByteImage | None


def object_of(
    result: ResultData,
    *,
    mesh: Mesh | str | os.PathLike[str] | None = None,
    image: Photo = None,
    images: Sequence[Photo] = (),
    world_from_cam: FloatArray | None = None,
    name: str = "model",
    metres: float = 1.0,
) -> AlignedObject:
    """The object of a result.

    Parameters
    ----------
    result : Result
    mesh : Mesh or path, optional
        The model's as given; it is warped where the result knows its model, see `Result.mesh`.
    image : path or (h, w, 3) uint8, optional
        The photo of the only view.
    images : sequence
        The photos of several views, in the place of ``image``.
    world_from_cam, name, metres
        As for `AlignedObject`.

    Raises
    ------
    InputError
        If there are more or fewer images than the result has views.
    """
    photos: list[Photo] = list(images) or [image] + [None] * (len(result.views) - 1)
    if len(photos) != len(result.views):
        what = f"{len(photos)}, but the result has {len(result.views)} views"
        raise InputError(what, where="images", fix="give one or None for each")
    return AlignedObject(
        tuple(_exported(view, photo) for view, photo in zip(result.views, photos, strict=True)),
        result.points_3d,
        result.ids,
        result.known_mesh(mesh),
        result.rig_from_model,
        world_from_cam,
        name,
        metres,
    )


object_of_fit = object_of_align = object_of
"""Names of earlier versions."""


def _exported(view: ViewResult, photo: Photo) -> ExportView:
    """A view without the keypoints behind its camera, and those whose ids an older file lacks."""
    ahead = np.flatnonzero(np.isfinite(view.residuals).all(axis=1))[: len(view.ids)]
    ids = tuple(view.ids[row] for row in ahead.tolist())
    return ExportView(view.camera, view.alignment, photo, view.points_2d[ahead], ids)
