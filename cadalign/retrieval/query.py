"""Retrieval of models by an observation."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.errors import DataError
from cadalign.io.documents import name_file
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
    """Settings of retrievals by observations."""

    library: Path
    """Library file of `cadalign library build`."""
    shape: Path | None = None
    """File that `cadalign shape learn` wrote. With it, models of its category are ranked by their
    similarity to the shape estimated from the keypoints, for objects not in the library."""
    sigma: float | None = None
    """Standard deviation of the keypoints [px]; by default the observation's, or 1."""
    ranking: RetrievalOptions = field(default_factory=RetrievalOptions)

    def open_files(self) -> tuple[Library, ShapeModel | None]:
        """Read the library and the shape model, cached; raises DataError if unreadable."""
        if self.shape is None:
            return _library(self.library), None
        from cadalign.shapes.model import open_shape  # not needed for the commands' help

        return _library(self.library), open_shape(self.shape)

    def read(
        self, data: Any, where: str, *, folder: Path, changes: ObservationChanges
    ) -> Observation:
        """Convert a parsed observation and apply changes; its keypoints need no xyz."""
        with name_file(where):
            seen = Observation.from_dict(data, folder=folder, needs_xyz=False)
        return changes.apply(seen, where)

    def resolve_ids(self, seen: Observation, where: str) -> Observation:
        """Add the library's semantic ids by keypoint names, unless the observation has ids.

        Raises DataError if there are no keypoints, or if they have neither ids nor names;
        InputError if the library lacks a name.
        """
        if seen.ids is not None and len(seen.points_2d):
            return seen
        with name_file(where):
            if not len(seen.points_2d):
                raise DataError("there are no keypoints")
            if seen.names is None:
                fix = "give each its id or name in the library"
                raise DataError("the keypoints have no semantic_id and no name", fix=fix)
            return replace(seen, ids=self.open_files()[0].ids_of(seen.names))

    def retrieve(self, seen: Observation, where: str, *, workers: int = -1) -> list[Match]:
        """Rank the library's models by an observation with ids; see `Library.retrieve`."""
        if seen.others:
            message = "%s: models are ranked by the first of its %d photos alone"
            logger.warning(message, where, len(seen.views))
        library, shape = self.open_files()
        assert seen.ids is not None
        own_sigma = 1.0 if seen.sigma is None else seen.sigma
        sigma = own_sigma if self.sigma is None else self.sigma
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
    from cadalign.retrieval.library import Library  # not needed for the commands' help

    return Library.open(path)
