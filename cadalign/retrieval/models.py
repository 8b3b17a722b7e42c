"""Models of a library: `LibraryModel`, the `ModelTable` of all, and its file.

The file is sealed (see `cadalign.io.files`) about an Arrow IPC file of the columns of `SCHEMA`.
Opening maps it into memory and compares the checksum, which reads the file once: 50,000 models of
10 keypoints are 30 MB and take some 0.1 s. Processes that open the same file share its memory.
"""

from __future__ import annotations

import logging
import os
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points, read_only
from cadalign.datasets import AnnotatedModel, load_mesh
from cadalign.errors import CadalignError, InputError, quote
from cadalign.geometry.alignment import extent
from cadalign.io.files import Seal, as_path, open_input

logger = logging.getLogger("cadalign")
ModelKey = tuple[str, str]
"""Category name and model id."""

_LARGEST = 1e50  # coordinate
_NAMES = b"names"  # of the schema's metadata
_MOST_BYTES = 1 << 40  # mapped, not read; a million models are 0.8 GB
SEAL = Seal(
    magic=b"cadalign library",
    version=1,
    noun="library file",
    fix="build it with: cadalign library build",
)
SCHEMA = pa.schema(
    [
        ("category", pa.string()),
        ("model_id", pa.string()),
        ("mesh", pa.string()),
        ("bounds", pa.list_(pa.float64(), 6)),
        ("keypoints", pa.list_(pa.list_(pa.float64(), 3))),
        ("semantic_ids", pa.list_(pa.int64())),
    ]
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


def table_of(
    models: Iterable[LibraryModel | AnnotatedModel], names: Mapping[str, int] | None = None
) -> pa.Table:
    """Make the table of models, sorted; ``names`` are semantic ids by the keypoints' names.

    Raises InputError if two models have the same category and id.
    """
    key_of = itemgetter("category", "model_id")
    rows = sorted(map(_row_of, models), key=key_of)
    for first, second in pairwise(rows):
        if key_of(first) == key_of(second):
            what = f"the model {first['model_id']!r} of {first['category']!r} occurs twice"
            fix = "give every model of a category its own id"
            raise InputError(what, where="library", fix=fix)
    table = pa.Table.from_pylist(rows, schema=SCHEMA)
    stored = msgspec.json.encode(names, order="deterministic")
    return table if names is None else table.replace_schema_metadata({_NAMES: stored})


def _row_of(model: object) -> dict[str, Any]:
    """Convert a model to a row of the table, its keypoints in the order of their ids."""
    if isinstance(model, AnnotatedModel):
        model = LibraryModel.of_annotated(model)
    if not isinstance(model, LibraryModel):
        what = f"expected a LibraryModel or a data set's model, got {type(model).__name__}"
        raise InputError(what, where="models", fix="give the models of `cadalign.datasets`")
    order = np.argsort(model.ids)
    return {
        "category": model.category,
        "model_id": model.model_id,
        "mesh": None if model.mesh_path is None else str(model.mesh_path),
        "bounds": model.bounds.ravel().tolist(),
        "keypoints": model.xyz[order].tolist(),
        "semantic_ids": model.ids[order].tolist(),
    }


class ModelTable:
    """All models of a library, sorted by category and id: arrays on an Arrow table of `SCHEMA`."""

    def __init__(self, table: pa.Table) -> None:
        self.table = table.combine_chunks()

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def keys(self) -> tuple[ModelKey, ...]:
        """Category and model id of every model, sorted."""
        columns = (self.table[name].to_pylist() for name in ("category", "model_id"))
        return tuple(zip(*columns, strict=True))

    @cached_property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories, sorted."""
        return tuple(sorted(self.table["category"].unique().to_pylist()))

    @cached_property
    def offsets(self) -> IntArray:
        """Start of each model's keypoints, and the end of the last, (n + 1,) int."""
        return _offsets(self._column("semantic_ids"))

    @cached_property
    def xyz(self) -> FloatArray:
        """Keypoints of all models, each model's in the order of their ids, (k, 3) float."""
        return _numbers(self._column("keypoints").flatten().flatten()).reshape(-1, 3)

    @cached_property
    def ids(self) -> IntArray:
        """Semantic ids of `xyz`, (k,) int."""
        return _numbers(self._column("semantic_ids").flatten())

    @cached_property
    def bounds(self) -> FloatArray:
        """Lowest and highest coordinates of every model, (n, 2, 3) float."""
        return _numbers(self._column("bounds").flatten()).reshape(-1, 2, 3)

    @cached_property
    def names(self) -> dict[str, int]:
        """Semantic ids by the keypoints' names; empty where they have none."""
        stored = (self.table.schema.metadata or {}).get(_NAMES, b"{}")
        return msgspec.json.decode(stored, type=dict[str, int])

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
        path = self.table["mesh"][row].as_py()
        category, model_id = self.keys[row]
        xyz, ids, bounds = self.xyz[own], self.ids[own], self.bounds[row]
        return LibraryModel(category, model_id, xyz, ids, bounds, path and Path(path))

    def payload(self) -> pa.Buffer:
        """All content, as the file of a library has it."""
        sink = pa.BufferOutputStream()
        with pa.ipc.new_file(sink, self.table.schema) as writer:
            writer.write_table(self.table)
        return sink.getvalue()

    def _column(self, name: str) -> Any:
        column = self.table[name]
        return column.chunk(0) if column.num_chunks else pa.array([], type=column.type)


def _numbers(array: Any) -> npt.NDArray[Any]:
    """View an Arrow array as a read-only NumPy array, without a copy."""
    numbers = array.to_numpy(zero_copy_only=True)
    numbers.flags.writeable = False
    return np.asarray(numbers)


def _offsets(array: Any) -> IntArray:
    offsets = array.offsets.to_numpy().astype(np.int64)
    offsets -= offsets[0] if len(offsets) else 0
    offsets.flags.writeable = False
    return np.asarray(offsets)


def read_library(path: str | os.PathLike[str]) -> pa.Table:
    """Map a library's file into memory and check it."""
    file, where = as_path(path), str(path)
    with open_input(file, most=_MOST_BYTES), pa.memory_map(where) as source:
        content = source.read_buffer()
    payload = SEAL.unwrap(content, where)
    try:
        with pa.ipc.open_file(pa.BufferReader(pa.py_buffer(payload))) as reader:
            table = reader.read_all()
        _check_table(table)
        _ = ModelTable(table).names
    except (pa.ArrowException, OSError, ValueError, msgspec.MsgspecError) as error:
        raise SEAL.error(f"is invalid: {str(error)[:200]}", where) from None
    return table


def _check_table(table: pa.Table) -> None:
    """Refuse a table whose indices could lead out of its memory, whatever its checksum."""
    if not table.schema.equals(SCHEMA):
        raise ValueError("it has other columns")
    table.validate(full=True)
    if any(table[name].null_count for name in table.column_names if name != "mesh"):
        raise ValueError("a value is missing")
    found = ModelTable(table)  # of which a missing number cannot be viewed
    points, ids = (pc.list_value_length(table[name]) for name in ("keypoints", "semantic_ids"))
    if len(found.xyz) != len(found.ids) or not points.equals(ids):
        raise ValueError("keypoints and semantic_ids differ in length")
    if not all((np.abs(each) < _LARGEST).all() for each in (found.xyz, found.bounds)):
        raise ValueError("a coordinate is NaN, infinite or so large that its powers are")
    if list(found.keys) != sorted(set(found.keys)):
        raise ValueError("models are not sorted by category and id")
