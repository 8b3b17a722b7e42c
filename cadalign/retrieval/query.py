"""Retrieval of models by an observation."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.datasets.image_keypoints import first_names, plain_name
from cadalign.errors import DataError, InputError, quote, refuse_unused, unknown_name
from cadalign.io.documents import convert, name_file, read_json
from cadalign.io.files import once_per_file
from cadalign.io.observation import Observation, ObservationChanges
from cadalign.retrieval.options import RetrievalOptions

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.shapes.model import ShapeModel

logger = logging.getLogger("cadalign")

_LEAST_KEYPOINTS = 3
_Table = tuple[tuple[str, str | int], ...]
"""Pairs of a library's keypoint name and the shape's name or id."""
_NO_TABLE: _Table = ()


@dataclass(frozen=True, kw_only=True)
class ObservationRetrieval:
    """Settings of retrievals by observations."""

    library: Path
    """Library file of `cadalign library build`."""
    shape: Path | None = None
    """Category of a shape that comes with cadalign, or shape file. With it, models of the category
    are ranked by their similarity to the shape estimated from the keypoints, for objects not in the
    library."""
    keypoint_names: Path | None = None
    """JSON table of the library's keypoint names, with the shape's name or id of each, if they
    differ. With --shape only."""
    sigma: float | None = None
    """Standard deviation of the keypoints [px]; by default the observation's, or 1."""
    ranking: RetrievalOptions = field(default_factory=RetrievalOptions)

    def open_files(self) -> tuple[Library, ShapeModel | None]:
        """Read the library and the shape model, cached; raises DataError if unreadable."""
        if self.shape is None:
            refuse_unused(self, ("keypoint_names",), "without a shape")
            return _library(self.library), None
        from cadalign.shapes.model import open_shape  # not needed for the commands' help

        library, shape = _library(self.library), open_shape(self.shape)
        table = _NO_TABLE if self.keypoint_names is None else _read_table(self.keypoint_names)
        return library, _shape_of_library(shape, library, table, str(self.library))

    def read(
        self, data: Any, where: str, *, folder: Path, changes: ObservationChanges
    ) -> Observation:
        """Convert a parsed observation and apply changes; its keypoints need no xyz."""
        with name_file(where):
            seen = Observation.from_dict(data, folder=folder, needs_xyz=False)
        return changes.apply(seen, where)

    def resolve_ids(self, seen: Observation, where: str) -> Observation:
        """Add the library's semantic ids by keypoint names, unless the observation has ids.

        With a shape, names may be the shape's; ids are always the library's.

        Raises DataError if there are no keypoints, or if they have neither ids nor names;
        InputError if the library lacks a name.
        """
        library, shape = self.open_files()
        if shape is not None and seen.names and {*seen.names} <= {*shape.names}:
            return replace(seen, ids=np.array(shape.ids)[shape.rows(seen.names)])
        ids = seen.ids
        with name_file(where):
            if not len(seen.points_2d):
                raise DataError("there are no keypoints")
            if ids is None:
                if seen.names is None:
                    fix = "give each its id or name in the library"
                    raise DataError("the keypoints have no semantic_id and no name", fix=fix)
                ids = library.ids_of(seen.names)
        if shape is None or not shape.names:
            return replace(seen, ids=ids)
        # `cadalign fit --shape` knows the shape's names, but not the library's ids.
        name_of = dict(zip(shape.ids, shape.names, strict=True))
        given = seen.names or [f"keypoint {label}" for label in ids]
        names = [name_of.get(int(label), name) for label, name in zip(ids, given, strict=True)]
        return replace(seen, ids=ids, names=tuple(names))

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


# Cached, since caches of the ranking and of estimates are by the shape.
@lru_cache(4)
def _shape_of_library(shape: ShapeModel, library: Library, table: _Table, where: str) -> ShapeModel:
    return relabel(shape, library.names, dict(table), where=where)


@once_per_file(4)
def _library(path: Path) -> Library:
    from cadalign.retrieval.library import Library  # not needed for the commands' help

    return Library.open(path)


def relabel(
    shape: ShapeModel, names: Mapping[str, int], table: Mapping[str, str | int], *, where: str
) -> ShapeModel:
    """Give a shape's keypoints the ids that a library has for them.

    ``names`` are the library's ids by name, ``table`` the shape's name or id of those that differ.
    Without names of its own, the library has the shape's ids. Raises InputError if the table has an
    unknown name or gives a keypoint twice, or fewer than 3 keypoints agree.
    """
    if unused := [name for name in table if name not in names]:
        raise unknown_name("keypoint of the library", unused[0], names, where="keypoint_names")
    if not names or not (table or shape.names):
        return shape
    row_of = {f"keypoint {label}": row for row, label in enumerate(shape.ids)}
    row_of |= {plain_name(name): row for row, name in enumerate(shape.names)}
    own = {row_of.get(plain_name(each), -1): names[each] for each in names if each not in table}
    own.pop(-1, None)
    named = dict[int, str]()
    for row, name in zip(shape.rows(table.values(), where="keypoint_names"), table, strict=True):
        if (other := named.setdefault(int(row), name)) != name:
            what = f"{quote(other)} and {quote(name)} are one keypoint of {shape.category}"
            raise InputError(what, where="keypoint_names", fix="leave out one of the two")
        own[int(row)] = names[name]
    if len(own) < _LEAST_KEYPOINTS:
        what = f"{len(own)} of its keypoints ({first_names(list(names))}) are {shape.category}'s"
        fix = "give keypoint_names, a JSON table of its names with the shape's names"
        raise InputError(what, where=where, fix=fix)
    free = count(1 + max(names.values()))  # for keypoints that the library lacks
    ids = tuple(own[row] if row in own else next(free) for row in range(len(shape.ids)))
    return replace(shape, ids=ids)


@once_per_file(4)
def _read_table(path: Path) -> _Table:
    with name_file(path):
        entries = convert(read_json(path), dict[str, Any]).items()
        return tuple((name, convert(each, str | int, name)) for name, each in entries)
