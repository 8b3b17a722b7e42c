"""Models of a library: `LibraryModel`, the `ModelTable` of all, and its file.

The file is a sealed MessagePack document (see `cadalign.io.files`) of the table's fields, arrays
as little-endian numbers: 50,000 models of 10 keypoints are 30 MB and open in some 0.1 s.
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
_MOST_BYTES = 1 << 33  # of ten million models
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
    """Lowest and highest coordinates of the mesh (2, 3); of the keypoints without a mesh."""
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
    def of_annotated(cls, model: AnnotatedModel, *, with_mesh: bool = True) -> LibraryModel:
        """Make a library model of a data set's model, with the bounds of its mesh."""
        mesh = model.mesh_path if with_mesh else None
        return cls.measured(
            model.category, model.model_id, model.keypoints.xyz, model.keypoints.ids, mesh
        )

    @classmethod
    def measured(
        cls, category: str, model_id: str, xyz: FloatArray, ids: IntArray, mesh: Path | None
    ) -> LibraryModel:
        """Make a model with the bounds of its mesh.

        Without a mesh, or with a warning where it cannot be read, they are those of the keypoints.
        """
        own = category, model_id, xyz, ids
        try:
            if mesh is not None:
                return cls(*own, load_mesh(mesh).bounds, mesh.absolute())
        except CadalignError as error:
            logger.warning("bounds are the keypoints': %s", error)
        return cls(*own, extent(xyz) if len(xyz) else np.zeros((2, 3)))

    @property
    def key(self) -> ModelKey:
        """Category and model id."""
        return self.category, self.model_id


def check_semantic_ids(value: Any, count: int, *, where: str) -> IntArray:
    """Convert semantic ids to (count,) int; raises InputError if invalid or repeated."""
    ids = np.asarray(value)
    if ids.shape != (count,) or (count and ids.dtype.kind not in "iu"):
        what = f"{ids.dtype} of shape {ids.shape}, expected whole numbers of shape ({count},)"
        raise InputError(what, where=where)
    unique, occurrences = np.unique(ids, return_counts=True)
    if (occurrences > 1).any():
        raise InputError(f"the semantic id {unique[occurrences > 1][0]} occurs twice", where=where)
    return ids.astype(np.int64)


def checked_key(key: object, where: str) -> ModelKey:
    """A model's category and id; InputError for anything else, which would name no model."""
    match key:
        case (str(category), str(model_id)) | [str(category), str(model_id)]:
            return category, model_id
    what = f"{quote(key)} is not a model's category and id"
    raise InputError(what, where=where, fix='give pairs, as ("chair", model_id)')


class _Stored(Document):
    """The content of a library's file."""

    keys: list[ModelKey]
    meshes: list[str | None]
    names: dict[str, int]
    offsets: bytes
    ids: bytes
    xyz: bytes
    bounds: bytes


@dataclass(frozen=True, eq=False)
class ModelTable:
    """All models of a library, sorted by category and id, in arrays."""

    keys: tuple[ModelKey, ...]
    """Category and model id of every model."""
    meshes: tuple[str | None, ...]
    """Paths of the meshes, None where there is none."""
    names: Mapping[str, int]
    """Semantic ids by the keypoints' names; empty where they have none."""
    offsets: IntArray
    """Start of each model's keypoints, and the end of the last, (n + 1,) int."""
    ids: IntArray
    """Semantic ids of `xyz`, (k,) int."""
    xyz: FloatArray
    """Keypoints of all models, each model's in the order of their ids, (k, 3) float."""
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
        """Make a library of models, or of a data set, of which meshes are read for their bounds.

        If a mesh cannot be read, the keypoints' bounds are used, with a warning (logger
        "cadalign").

        Parameters
        ----------
        models : iterable of LibraryModel or AnnotatedModel
        names : mapping of str to int, optional
            Semantic ids by the keypoints' names.

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
        """Read a saved library.

        Raises
        ------
        DataError
            If the file is missing, truncated, damaged, of another version, or of another format.
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
        """Refuse arrays whose indices could lead out of them, whatever the file's checksum."""
        count, starts = len(self.keys), self.offsets
        if not len(self.meshes) == len(self.bounds) == len(starts) - 1 == count:
            raise ValueError("its models have too few or too many values")
        is_ascending = starts[0] == 0 and bool((np.diff(starts) >= 0).all())
        if not (is_ascending and starts[-1] == len(self.ids) == len(self.xyz)):
            raise ValueError("keypoints and semantic ids differ in number")
        if not all((np.abs(each) < _LARGEST).all() for each in (self.xyz, self.bounds)):
            raise ValueError("a coordinate is NaN, infinite or so large that its powers are")
        if list(self.keys) != sorted(set(self.keys)):
            raise ValueError("models are not sorted by category and id")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the library to a file atomically; raises DataError on failure."""
        SEAL.write(as_path(path), self._payload)

    @property
    def fingerprint(self) -> str:
        """Hash of the library's content, as text."""
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
        """Semantic ids of a category's models, or of all, ascending."""
        rows = slice(0, len(self)) if category is None else self.rows_of(category)
        return np.unique(self.ids[self.offsets[rows.start] : self.offsets[rows.stop]])

    def rows_of(self, category: str) -> slice:
        """Rows of a category's models."""
        names = [name for name, _ in self.keys]
        return slice(bisect_left(names, category), bisect_right(names, category))

    def keypoints_of(self, category: str) -> tuple[IntArray, FloatArray]:
        """Semantic ids (k,) of a category, and the keypoints (m, k, 3) of its models.

        NaN where a model lacks one.
        """
        rows = self.rows_of(category)
        offsets = self.offsets[rows.start : rows.stop + 1]
        own = slice(int(offsets[0]), int(offsets[-1]))
        ids, column = np.unique(self.ids[own], return_inverse=True)
        points = np.full((len(offsets) - 1, len(ids), 3), np.nan)
        points[np.repeat(np.arange(len(points)), np.diff(offsets)), column] = self.xyz[own]
        return ids, points

    def model(self, row: int) -> LibraryModel:
        """Make the model of a row."""
        own = slice(int(self.offsets[row]), int(self.offsets[row + 1]))
        mesh, xyz, ids = self.meshes[row], self.xyz[own], self.ids[own]
        path = None if mesh is None else Path(mesh)
        return LibraryModel(*self.keys[row], xyz, ids, self.bounds[row], path)


def _library_model(model: object) -> LibraryModel:
    if isinstance(model, AnnotatedModel):
        return LibraryModel.of_annotated(model)
    if not isinstance(model, LibraryModel):
        what = f"expected a LibraryModel or a data set's model, got {type(model).__name__}"
        raise InputError(what, where="models", fix="give the models of `cadalign.datasets`")
    return model


def _little_endian(array: Any) -> bytes:
    data: bytes = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    return data
