"""Retrieval of models by an observation."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import IntArray
from cadalign.datasets.image_keypoints import first_names
from cadalign.errors import DataError, InputError, quote, refuse_unused, unknown_name
from cadalign.io.documents import convert, name_file, read_json
from cadalign.io.files import once_per_file
from cadalign.io.observation import Observation, ObservationChanges
from cadalign.retrieval.options import RetrievalOptions
from cadalign.shapes.parts import plain_name

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.shapes.model import ShapeModel

logger = logging.getLogger("cadalign")

_LEAST_KEYPOINTS = 3
_Table = tuple[tuple[str, str | int], ...]
"""Pairs of a library's keypoint name and the shape's name or id."""


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
        table: _Table = () if self.keypoint_names is None else _read_table(self.keypoint_names)
        return library, relabel(shape, library, table, str(self.library))

    def read(
        self, data: Any, where: str, *, folder: Path, changes: ObservationChanges
    ) -> Observation:
        """Convert a parsed observation and apply changes; its keypoints need no xyz."""
        with name_file(where):
            seen = Observation.from_dict(data, folder=folder, needs_xyz=False)
        return changes.apply(seen, where)

    def resolve_ids(self, seen: Observation, where: str) -> Observation:
        """Find the library's semantic ids of an observation's keypoints.

        Names count: the library's if it has them all, otherwise the shape's. The observation's own
        ids are kept if they agree with one of the two, or if neither has the names. The result has
        the shape's names, since `cadalign fit --shape` does not know the library's ids.

        Raises DataError if there are no keypoints, or if they have neither ids nor names;
        InputError if the library lacks a name.
        """
        library, shape = self.open_files()
        with name_file(where):
            if not len(seen.points_2d):
                raise DataError("there are no keypoints")
            ids = _ids_in_library(seen, library, shape)
        if shape is None or not shape.names:
            return replace(seen, ids=ids)
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


def _ids_in_library(seen: Observation, library: Library, shape: ShapeModel | None) -> IntArray:
    """The library's ids (n,) of an observation's keypoints; see `resolve_ids`."""
    ids, names = seen.ids, seen.names
    if names is None:
        if ids is None:
            fix = "give each its id or name in the library"
            raise DataError("the keypoints have no semantic_id and no name", fix=fix)
        return ids
    by_name, of_shape = list[IntArray](), () if shape is None else (shape.resolve,)
    for read in (library.ids_of, *of_shape):
        with suppress(InputError):
            by_name.append(np.array(read(names)))
    if ids is not None and (not by_name or any(np.array_equal(ids, each) for each in by_name)):
        return ids
    return by_name[0] if by_name else library.ids_of(names)


@once_per_file(4)
def _library(path: Path) -> Library:
    from cadalign.retrieval.library import Library  # not needed for the commands' help

    return Library.open(path)


@lru_cache(4)  # caches of the ranking and of estimates are by the shape
def relabel(shape: ShapeModel, library: Library, pairs: _Table, where: str) -> ShapeModel:
    """Give a shape's keypoints the ids that a library has for them.

    The pairs are of the library's names that differ from the shape's. Without names of its own, the
    library has the shape's ids. Raises InputError if the table has an unknown name, two names mean
    one keypoint, or fewer than 3 keypoints agree.
    """
    names, table = library.names, dict(pairs)
    if unused := [name for name in table if name not in names]:
        raise unknown_name("keypoint of the library", unused[0], names, where="keypoint_names")
    if not names or not (table or shape.names):
        return shape
    shape.resolve(table.values(), where="keypoint_names")
    numbers = {f"keypoint {label}": label for label in shape.ids}
    labels = [table.get(name, numbers.get(plain_name(name), name)) for name in names]
    known = zip(shape.resolve(labels, where=None), names.items(), strict=True)
    found = [(own, number, name) for own, (name, number) in known if own is not None]
    for (own, number, name), (other, second, other_name) in combinations(found, 2):
        if (own == other) != (number == second):
            of = shape.category if own == other else "the library"
            what = f"{quote(name)} and {quote(other_name)} are one keypoint of {of}"
            fix = "give each name a keypoint of its own"
            raise InputError(what, where="keypoint_names" if table else where, fix=fix)
    ids = {own: number for own, number, _ in found}
    if len(ids) < _LEAST_KEYPOINTS:
        what = f"{len(ids)} of its keypoints ({first_names(list(names))}) are {shape.category}'s"
        fix = "give keypoint_names, a JSON table of its names with the shape's names"
        raise InputError(what, where=where, fix=fix)
    free = count(1 + max(*names.values(), *library.known_ids().tolist()))  # that the library lacks
    return replace(shape, ids=tuple(ids[own] if own in ids else next(free) for own in shape.ids))


@once_per_file(4)
def _read_table(path: Path) -> _Table:
    with name_file(path):
        entries = convert(read_json(path), dict[str, Any]).items()
        return tuple((name, convert(each, str | int, name)) for name, each in entries)
