"""Queries: observations whose models are retrieved, and the options of that."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.errors import DataError, InputError
from cadalign.io.documents import in_file
from cadalign.io.files import once_per_file, time_of
from cadalign.io.focal import FocalPrior
from cadalign.io.observation import Observation
from cadalign.retrieval.options import RetrievalOptions

if TYPE_CHECKING:
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

    def with_ids(self, seen: Observation, where: str) -> Observation:
        """The observation with the library's semantic ids, by names where it has none itself.

        Raises
        ------
        DataError
            If the keypoints have neither, or there are none.
        InputError
            If the library has no such names.
        """
        if seen.ids is not None and len(seen.points_2d):
            return seen
        with in_file(where):
            if not len(seen.points_2d):
                raise DataError("there are no keypoints")
            if seen.names is None:
                fix = "give each the id, or the name, of the library's models for it"
                raise DataError("the keypoints have no semantic_id and no name", fix=fix)
            return replace(seen, ids=self.opened()[0].ids_of(seen.names))

    def retrieve(self, seen: Observation, where: str, *, workers: int = -1) -> list[Match]:
        """Rank the library's models by an observation, which messages call ``where``.

        ``workers`` are as for `Library.retrieve`.

        Raises
        ------
        CadalignError
            As for `Library.retrieve`; or if the keypoints have neither semantic ids nor names.
        """
        if seen.others:
            said = "%s: models are ranked by the first of its %d photos alone"
            logger.warning(said, where, len(seen.views))
        library, shape = self.opened()
        camera, ids = seen.camera, self.with_ids(seen, where).ids
        assert ids is not None
        if shape is None and not camera.focal_known:
            what = "the focal length is unknown, without which no model's pose is searched"
            fix = "rank by `shape`, which estimates it, or give a calibrated camera"
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
        raise InputError(f"two files of the category {twice!r}", where="shape")
    return by_category
