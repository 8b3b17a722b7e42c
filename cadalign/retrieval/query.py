"""Queries: observations whose models are retrieved, the options of that, masks and opacity."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.arrays import BoolArray, IntArray
from cadalign.errors import DataError, InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.geometry.camera import Camera
from cadalign.io.documents import in_file
from cadalign.io.files import once_per_file, time_of
from cadalign.io.images import is_grey, open_photo, read_image, read_mask
from cadalign.io.observation import Observation
from cadalign.retrieval.options import RetrievalOptions

if TYPE_CHECKING:
    from cadalign.render.drawing.canvas import ByteImage
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.shapes.model import ShapeModel


logger = logging.getLogger("cadalign")


@dataclass(frozen=True, kw_only=True)
class ObservationRetrieval:
    """Settings of the retrieval of an observation's model."""

    library: Path
    """File that `cadalign library build` wrote."""
    shape: tuple[Path, ...] = ()
    """Files that `cadalign shape learn` wrote, one for each category: ranks their models by the
    shape estimated from the keypoints, for objects that are not in the library. An unknown focal
    length is estimated with it, with the photo's EXIF data as a prior."""
    silhouette: bool = False
    """Rank the matches again by the object's pixels: those of the photo's opacity, or what is
    segmented around the keypoints; without it, by the observation's mask if it has one."""
    sigma: float | None = None
    """Standard deviation of the keypoints [px]; by default the file's, or 1."""
    ranking: RetrievalOptions = field(default_factory=RetrievalOptions)

    def opened(self) -> tuple[Library, ShapeModel | dict[str, ShapeModel] | None]:
        """The library and the shapes, which runs use again and again.

        Raises
        ------
        DataError
            If a file cannot be read.
        InputError
            If two shapes are of the same category.
        """
        shapes = tuple((path, time_of(path)) for path in self.shape)
        return _opened_library(self.library), _opened_shapes(shapes)

    def retrieve(
        self, seen: Observation, where: str, *, mask: BoolArray | None = None, workers: int = -1
    ) -> list[Match]:
        """Rank the library's models by an observation, which messages call ``where``.

        ``mask``, by default the observation's, and ``workers`` are as for `Library.retrieve`.

        Raises
        ------
        CadalignError
            As for `Library.retrieve`; or if the keypoints have no semantic ids, or the photo cannot
            be read.
        """
        if seen.others:
            said = "%s: models are ranked by the first of its %d photos alone"
            logger.warning(said, where, len(seen.views))
        library, shape = self.opened()
        camera, ids = seen.camera, _semantic_ids(seen, where)
        if mask is None and seen.evidence.mask is not None and not self.silhouette:
            mask = read_mask(seen.evidence.mask)  # as a fit to the observation reads it
        if shape is None and not camera.focal_known:
            what = "the focal length is unknown, without which no model's pose is searched"
            fix = "rank by --shape, which estimates it, or give a calibrated camera"
            raise InputError(what, where=f"{where}: camera", fix=fix)
        prior = None
        if not camera.focal_known and seen.image is not None:
            prior = FocalPrior.from_exif(seen.image)
        stated = 1.0 if seen.sigma is None else seen.sigma
        sigma = stated if self.sigma is None else self.sigma
        return library.retrieve(
            seen.points_2d,
            ids,
            camera,
            **vars(replace(self.ranking, sigma=sigma)),
            shape=shape,
            focal_prior=prior,
            mask=mask,
            image=read_opacity(seen.image, camera) if self.silhouette else None,
            workers=workers,
        )


@once_per_file(4)
def _opened_library(path: Path) -> Library:
    from cadalign.retrieval.library import Library  # only here: help of a command needs none

    return Library.open(path)


@lru_cache(maxsize=4)
def _opened_shapes(
    files: Sequence[tuple[Path, int]],
) -> ShapeModel | dict[str, ShapeModel] | None:
    """The shape models of files: one, or several by category; None of no file."""
    from cadalign.shapes.model import ShapeModel  # not for help of a command

    models = [ShapeModel.open(path) for path, _ in files]
    if len(models) < 2:
        return models[0] if models else None
    by_category = {model.category: model for model in models}
    if len(by_category) < len(models):
        names = [model.category for model in models]
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two files of the category {twice!r}", where="--shape")
    return by_category


def read_query(path: Path) -> Observation:
    """Read an observation file for retrieval.

    The format is that of `cadalign.io.observation`, but keypoints must have a ``semantic_id`` and
    may lack ``xyz``, which is zero in the returned observation and not used.
    """
    query = Observation.load(path, needs_xyz=False)
    _semantic_ids(query, str(path))
    return query


def _semantic_ids(query: Observation, where: str) -> IntArray:
    if not len(query.points_2d):
        with in_file(where):
            raise DataError("there are no keypoints")
    if query.ids is None:
        fix = "give each the id of the library's models for it"
        with in_file(where):
            raise DataError("the keypoints have no semantic_id", fix=fix)
    return query.ids


def read_query_mask(path: Path, camera: Camera) -> BoolArray:
    """Read an object's pixels, (h, w) bool; raises as `read_image`.

    Those of one channel are read as a fit reads them, of a coloured image they are the bright ones.
    """
    mask = read_mask(path) if is_grey(path) else None
    if mask is not None and mask.shape == (camera.height, camera.width):
        return mask
    return np.asarray(read_image(path, camera).mean(axis=2) > 127.5)


def read_opacity(path: Path | None, camera: Camera) -> ByteImage:
    """Read a photo with its opacity if it has one, (h, w, 3 or 4) uint8, upright by EXIF."""
    if path is None:
        fix = "add the image to the observation, or give the object's pixels with --mask"
        raise InputError("the observation names no image", where="--silhouette", fix=fix)
    colors = read_image(path, camera)
    from PIL import ImageOps

    with open_photo(path) as image:
        if not image.has_transparency_data:
            return colors
        # The transparent colour of a palette is no separate channel in the file.
        opacity = ImageOps.exif_transpose(image).convert("RGBA").getchannel("A")
        return np.dstack([colors, np.asarray(opacity)])
