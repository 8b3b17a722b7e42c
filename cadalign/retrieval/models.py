"""Models of a library: `LibraryModel`, the table `ModelTable` of all models, and its file.

The file is a sealed MessagePack document of the table's fields (see `cadalign.io.files`), with
arrays of little-endian numbers.
"""

from __future__ import annotations

import logging
import os
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points, read_only
from cadalign.datasets import AnnotatedModel, load_mesh
from cadalign.errors import CadalignError, InputError, quote
from cadalign.geometry.alignment import extent
from cadalign.io.documents import Document
from cadalign.io.files import Seal, as_path, checksum, read_bytes

logger = logging.getLogger("cadalign")
ModelKey = tuple[str, str]
"""Category name and model id."""

_LARGEST = 1e50  # coordinate
_MOST_BYTES = 1 << 33  # enough for ten million models
SEAL = Seal(
    magic=b"cadalign library",
    version=2,
    noun="library file",
    fix="build it with: cadalign library build",
)


@dataclass(frozen=True, eq=False)
class LibraryModel:
    """One model of a library.

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN, infinite or beyond 1e50, or a semantic id occurs
        twice.
    """

    category: str
    model_id: str
    xyz: FloatArray
    """Keypoints (k, 3) [model units]."""
    ids: IntArray
    """Semantic ids (k,), valid for all models of the category."""
    bounds: FloatArray
    """Lowest and highest coordinates (2, 3) of the mesh, or without one of the keypoints."""
    mesh_path: Path | None = None

    def __post_init__(self) -> None:
        where = f"{self.category}, model {self.model_id}"
        xyz = as_points(self.xyz, name=f"{where}, xyz", dimension=3)
        bounds = as_floats(self.bounds, name=f"{where}, bounds", shape=(2, 3))
        if not max(np.abs(xyz).max(initial=0), np.abs(bounds).max()) < _LARGEST:
            raise InputError(f"a coordinate exceeds {_LARGEST:g}", where=where)
        ids = check_semantic_ids(self.ids, len(xyz), where=f"{where}, ids")
        for name, value in (("xyz", xyz), ("bounds", bounds), ("ids", ids)):
            object.__setattr__(self, name, read_only(value))

    @classmethod
    def from_annotated(cls, model: AnnotatedModel, *, with_mesh: bool = True) -> LibraryModel:
        """Convert a model of a data set, with the bounds of its mesh."""
        mesh = model.mesh_path if with_mesh else None
        return cls.from_mesh(
            model.category, model.model_id, model.keypoints.xyz, model.keypoints.ids, mesh
        )

    @classmethod
    def from_mesh(
        cls, category: str, model_id: str, xyz: FloatArray, ids: IntArray, mesh: Path | None
    ) -> LibraryModel:
        """Make a model with the bounds of its mesh, or without one of its keypoints.

        An unreadable mesh gives a warning (logger "cadalign").
        """
        own = category, model_id, xyz, ids
        try:
            if mesh is not None:
                return cls(*own, load_mesh(mesh).bounds, mesh.absolute())
        except CadalignError as error:
            logger.warning("the bounds are taken from the keypoints: %s", error)
        return cls(*own, extent(xyz) if len(xyz) else np.zeros((2, 3)))

    @property
    def key(self) -> ModelKey:
        """Category and model id."""
        return self.category, self.model_id


def check_semantic_ids(value: Any, count: int, *, where: str) -> IntArray:
    """Convert semantic ids to (count,) int; raises InputError if they are invalid or repeated."""
    ids = np.asarray(value)
    if ids.shape != (count,) or (count and ids.dtype.kind not in "iu"):
        what = f"{ids.dtype} of shape {ids.shape}, expected whole numbers of shape ({count},)"
        raise InputError(what, where=where)
    unique, occurrences = np.unique(ids, return_counts=True)
    if (occurrences > 1).any():
        raise InputError(f"the semantic id {unique[occurrences > 1][0]} occurs twice", where=where)
    return ids.astype(np.int64)


def check_key(key: object, where: str) -> ModelKey:
    """Check a pair of category and model id; raises InputError for other values."""
    match key:
        case (str(category), str(model_id)) | [str(category), str(model_id)]:
            return category, model_id
    what = f"{quote(key)} is not a model's category and id"
    raise InputError(what, where=where, fix='give pairs, as ("chair", model_id)')


class _Stored(Document):
    keys: list[ModelKey]
    meshes: list[str | None]
    names: dict[str, int]
    offsets: bytes
    ids: bytes
    xyz: bytes
    bounds: bytes


@dataclass(frozen=True, eq=False)
class ModelTable:
    """Models of a library, sorted by category and id, in arrays."""

    keys: tuple[ModelKey, ...]
    """Category and model id of every model."""
    meshes: tuple[str | None, ...]
    """Path of every model's mesh, or None."""
    names: Mapping[str, int]
    """Semantic ids by keypoint name; empty without names."""
    offsets: IntArray
    """Start of every model's keypoints, and the end of the last model's, (n + 1,) int."""
    ids: IntArray
    """Semantic ids of `xyz`, (k,) int."""
    xyz: FloatArray
    """Keypoints of all models, (k, 3) float; each model's in the order of their ids."""
    bounds: FloatArray
    """Lowest and highest coordinates of every model, (n, 2, 3) float."""

    def __post_init__(self) -> None:
        for array in (self.offsets, self.ids, self.xyz, self.bounds):
            array.flags.writeable = False

    @classmethod
    def from_models(
        cls,
        models: Iterable[LibraryModel | AnnotatedModel],
        *,
        names: Mapping[str, int] | None = None,
    ) -> Self:
        """Make a library from models of any source, or from a data set.

        The meshes of a data set's models are read for their bounds. If one is unreadable, the
        bounds are taken from the keypoints, with a warning (logger "cadalign").

        Parameters
        ----------
        models : iterable of LibraryModel or AnnotatedModel
        names : mapping of str to int, optional
            Semantic ids by keypoint name.

        Raises
        ------
        InputError
            If two models have the same category and id.
        """
        every = sorted(map(_library_model, models), key=lambda model: model.key)
        for first, second in pairwise(every):
            if first.key == second.key:
                what = f"the model {first.model_id!r} of {first.category!r} occurs twice"
                fix = "give every model of a category its own id"
                raise InputError(what, where="library", fix=fix)
        orders = [np.argsort(model.ids) for model in every]
        pairs = list(zip(every, orders, strict=True))
        return cls(
            tuple(model.key for model in every),
            tuple(None if each.mesh_path is None else str(each.mesh_path) for each in every),
            dict(names or {}),
            np.cumsum([0, *map(len, orders)], dtype=np.int64),
            np.concatenate([np.empty(0, np.int64), *(m.ids[order] for m, order in pairs)]),
            np.concatenate([np.empty((0, 3)), *(m.xyz[order] for m, order in pairs)]),
            np.array([model.bounds for model in every]).reshape(-1, 2, 3),
        )

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Self:
        """Read a library file.

        Raises
        ------
        DataError
            If the file is missing, damaged, or of another version or format.
        """
        content = read_bytes(as_path(path), most=_MOST_BYTES)
        try:
            stored = msgspec.msgpack.decode(SEAL.unwrap(content, str(path)), type=_Stored)
            table = cls(
                tuple(stored.keys),
                tuple(stored.meshes),
                stored.names,
                np.frombuffer(stored.offsets, dtype="<i8"),
                np.frombuffer(stored.ids, dtype="<i8"),
                np.frombuffer(stored.xyz, dtype="<f8").reshape(-1, 3),
                np.frombuffer(stored.bounds, dtype="<f8").reshape(-1, 2, 3),
            )
            table._check()
        except (ValueError, msgspec.MsgspecError) as error:
            raise SEAL.error(f"is invalid: {str(error)[:200]}", str(path)) from None
        return table

    def _check(self) -> None:
        """Check the arrays of a file, whose indices could be out of bounds; raises ValueError."""
        count, starts = len(self.keys), self.offsets
        if not len(self.meshes) == len(self.bounds) == len(starts) - 1 == count:
            raise ValueError("meshes, bounds or offsets don't match the number of models")
        is_ascending = starts[0] == 0 and bool((np.diff(starts) >= 0).all())
        if not (is_ascending and starts[-1] == len(self.ids) == len(self.xyz)):
            raise ValueError("offsets, keypoints and semantic ids don't match")
        if not all((np.abs(each) < _LARGEST).all() for each in (self.xyz, self.bounds)):
            raise ValueError(f"a coordinate is NaN or exceeds {_LARGEST:g}")
        if list(self.keys) != sorted(set(self.keys)):
            raise ValueError("models are not sorted by category and id")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the library to a file atomically; raises DataError on failure."""
        SEAL.write(as_path(path), self._payload)

    @property
    def fingerprint(self) -> str:
        """Hash of the library's content, in hexadecimal."""
        return checksum(self._payload).hex()

    @property
    def _payload(self) -> bytes:
        content = {field.name: getattr(self, field.name) for field in fields(self)}
        return msgspec.msgpack.encode(content, enc_hook=_little_endian, order="deterministic")

    def __len__(self) -> int:
        return len(self.keys)

    @cached_property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories, sorted."""
        return tuple(sorted({category for category, _ in self.keys}))

    def known_ids(self, category: str | None = None) -> IntArray:
        """Semantic ids of a category's models or of all models, ascending."""
        rows = slice(0, len(self)) if category is None else self.rows_of(category)
        return np.unique(self.ids[self.offsets[rows.start] : self.offsets[rows.stop]])

    def rows_of(self, category: str) -> slice:
        """Rows of a category's models."""
        names = [name for name, _ in self.keys]
        return slice(bisect_left(names, category), bisect_right(names, category))

    def keypoints_of(self, category: str) -> tuple[IntArray, FloatArray]:
        """Semantic ids (k,) of a category, and its models' keypoints (m, k, 3), NaN if missing."""
        rows = self.rows_of(category)
        offsets = self.offsets[rows.start : rows.stop + 1]
        own = slice(int(offsets[0]), int(offsets[-1]))
        ids, column = np.unique(self.ids[own], return_inverse=True)
        points = np.full((len(offsets) - 1, len(ids), 3), np.nan)
        points[np.repeat(np.arange(len(points)), np.diff(offsets)), column] = self.xyz[own]
        return ids, points

    def model(self, row: int) -> LibraryModel:
        """Return the model of a row."""
        own = slice(int(self.offsets[row]), int(self.offsets[row + 1]))
        mesh, xyz, ids = self.meshes[row], self.xyz[own], self.ids[own]
        path = None if mesh is None else Path(mesh)
        return LibraryModel(*self.keys[row], xyz, ids, self.bounds[row], path)


def _library_model(model: object) -> LibraryModel:
    if isinstance(model, AnnotatedModel):
        return LibraryModel.from_annotated(model)
    if not isinstance(model, LibraryModel):
        what = f"expected a LibraryModel or a data set's model, got {type(model).__name__}"
        raise InputError(what, where="models", fix="give the models of `cadalign.datasets`")
    return model


def _little_endian(array: Any) -> bytes:
    data: bytes = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    return data
