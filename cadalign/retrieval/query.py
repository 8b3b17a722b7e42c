"""Retrieval of an observation's model."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import DataError
from cadalign.io.documents import in_file
from cadalign.io.files import once_per_file
from cadalign.io.observation import Observation, ObservationChanges
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
    """Library file of `cadalign library build`."""
    shape: Path | None = None
    """Shape file of `cadalign shape learn`, for objects that are not in the library: ranks its
    category's models by the shape estimated from the keypoints."""
    sigma: float | None = None
    """Standard deviation of the keypoint noise [px]; by default the file's value, or 1."""
    ranking: RetrievalOptions = field(default_factory=RetrievalOptions)

    def opened(self) -> tuple[Library, ShapeModel | None]:
        """The library and the shape, which runs use again and again; DataError if unreadable."""
        return _library(self.library), None if self.shape is None else _shape(self.shape)

    def read(
        self, data: Any, where: str, *, folder: Path, changes: ObservationChanges
    ) -> Observation:
        """Read the parsed form of an observation, with changes, whose keypoints need no xyz."""
        with in_file(where):
            seen = Observation.from_dict(data, folder=folder, needs_xyz=False)
        return changes.applied_to(seen, where)

    def with_ids(self, seen: Observation, where: str) -> Observation:
        """The observation with the library's semantic ids, by names where it has none itself.

        Raises DataError if there are no keypoints, or these have neither; InputError if the library
        has no such names.
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
        """Rank the library's models by an observation `with_ids`; see `Library.retrieve`."""
        if seen.others:
            said = "%s: models are ranked by the first of its %d photos alone"
            logger.warning(said, where, len(seen.views))
        library, shape = self.opened()
        assert seen.ids is not None
        stated = 1.0 if seen.sigma is None else seen.sigma
        sigma = stated if self.sigma is None else self.sigma
        return library.retrieve(
            seen.points_2d,
            seen.ids,
            seen.camera,
            **vars(replace(self.ranking, sigma=sigma)),
            shape=shape,
            workers=workers,
        )


@once_per_file(4)
def _library(path: Path) -> Library:
    from cadalign.retrieval.library import Library  # only here: help of a command needs none

    return Library.open(path)


@once_per_file(4)
def _shape(path: Path) -> ShapeModel:
    from cadalign.shapes.model import ShapeModel  # not for help of a command

    return ShapeModel.open(path)
