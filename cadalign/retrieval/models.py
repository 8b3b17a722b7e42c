"""Models of a library: `LibraryModel`, and `ModelTable` of all as an Arrow table."""

from __future__ import annotations

import json
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points, read_only
from cadalign.datasets import AnnotatedModel, Circle, RotationalSymmetry, Symmetries, load_mesh
from cadalign.errors import DataError, InputError
from cadalign.geometry.mesh import Mesh
from cadalign.names import renamed
from cadalign.retrieval.labelings import mirrored_labelings

ModelKey = tuple[str, str]
"""Category name and model id."""

SCHEMA = pa.schema(
    [
        ("category", pa.string()),
        ("model_id", pa.string()),
        ("mesh", pa.string()),
        ("bounds", pa.list_(pa.float64(), 6)),
        ("keypoints", pa.list_(pa.list_(pa.float64(), 3))),
        ("semantic_ids", pa.list_(pa.int64())),
        # Concatenated permutations of the rows, one for each mirrored labelling.
        ("labelings", pa.list_(pa.int64())),
        ("symmetries", pa.string()),
    ]
)


@renamed(semantic_ids="ids")
@dataclass(frozen=True, eq=False)
class LibraryModel:
    """One model of a library.

    Parameters
    ----------
    category, model_id : str
    xyz : (k, 3) float
        Keypoints [model units].
    ids : (k,) int
        Semantic ids, valid for all models of the category.
    bounds : (2, 3) float
        Lowest and highest coordinates of the mesh; of the keypoints without a mesh.
    symmetries : Symmetries, optional
        Reflections and rotations, as rows of ``xyz`` that exchange places.
    mesh_path : Path, optional

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, or a semantic id occurs twice.
    """

    category: str
    model_id: str
    xyz: FloatArray
    ids: IntArray
    bounds: FloatArray
    symmetries: Symmetries = field(default_factory=lambda: _no_symmetries())
    mesh_path: Path | None = None

    def __post_init__(self) -> None:
        where = f"{self.category}, model {self.model_id}"
        xyz = as_points(self.xyz, name=f"{where}, xyz", dimension=3)
        bounds = as_floats(self.bounds, name=f"{where}, bounds", shape=(2, 3))
        ids = check_semantic_ids(self.ids, len(xyz), where=f"{where}, ids")
        for name, value in (("xyz", xyz), ("bounds", bounds), ("ids", ids)):
            object.__setattr__(self, name, read_only(value))

    @classmethod
    def of_annotated(cls, model: AnnotatedModel, *, with_mesh: bool = True) -> LibraryModel:
        """Make a library model of a data set's model; the bounds are those of its mesh.

        Raises DataError if the mesh cannot be read; see ``with_mesh``.
        """
        xyz = model.keypoints.xyz
        bounds = np.array([xyz.min(axis=0), xyz.max(axis=0)])
        path = model.mesh_path if with_mesh else None
        if path is not None:
            bounds = load_mesh(path).bounds
        return cls(
            category=model.category,
            model_id=model.model_id,
            xyz=xyz,
            ids=model.keypoints.ids,
            bounds=bounds,
            symmetries=model.symmetries,
            mesh_path=None if path is None else path.absolute(),
        )

    @property
    def key(self) -> ModelKey:
        """Category and model id."""
        return self.category, self.model_id

    def load_mesh(self) -> Mesh:
        """Read the mesh; raises DataError if there is none or it cannot be read."""
        if self.mesh_path is None:
            raise DataError(
                "the model has no mesh", where=f"{self.category}, model {self.model_id}"
            )
        return load_mesh(self.mesh_path)


def check_semantic_ids(value: Any, count: int, *, where: str) -> IntArray:
    """Convert semantic ids to (count,) int; raises InputError if invalid or repeated."""
    ids = np.asarray(value)
    if ids.shape != (count,) or (count and ids.dtype.kind not in "iu"):
        raise InputError(
            f"{ids.dtype} of shape {ids.shape}, expected whole numbers of shape ({count},)",
            where=where,
        )
    unique, occurrences = np.unique(ids, return_counts=True)
    if (occurrences > 1).any():
        raise InputError(f"the semantic id {unique[occurrences > 1][0]} occurs twice", where=where)
    return ids.astype(np.int64)


class ModelTable:
    """All models of a library, sorted by category and id: arrays on an Arrow table of `SCHEMA`."""

    def __init__(self, table: pa.Table) -> None:
        self.table = table.combine_chunks()

    @classmethod
    def of(cls, models: Iterable[LibraryModel | AnnotatedModel]) -> ModelTable:
        """Make a table; raises InputError if two models have the same category and id."""
        return cls.of_rows(row_of(_library_model(model)) for model in models)

    @classmethod
    def of_rows(cls, rows: Iterable[dict[str, Any]]) -> ModelTable:
        """Make a table of what `row_of` makes of each model; raises as `of`."""

        def key_of(row: dict[str, Any]) -> ModelKey:
            return row["category"], row["model_id"]

        in_order = sorted(rows, key=key_of)
        for first, second in pairwise(in_order):
            if key_of(first) == key_of(second):
                raise InputError(
                    f"the model {first['model_id']!r} of {first['category']!r} occurs twice",
                    where="library",
                    fix="give every model of a category its own id",
                )
        return cls(pa.Table.from_pylist(in_order, schema=SCHEMA))

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def keys(self) -> Sequence[ModelKey]:
        """Category and model id of every model."""
        names = self.table["category"].to_pylist()
        return list(zip(names, self.table["model_id"].to_pylist(), strict=True))

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
    def labeling_offsets(self) -> IntArray:
        """Start of each model's mirrored labelings, and the end of the last, (n + 1,) int."""
        return _offsets(self._column("labelings"))

    @cached_property
    def places(self) -> IntArray:
        """Rows of `xyz`: the identity, then at `labeling_offsets` those of mirrored labels."""
        first = np.repeat(self.offsets[:-1], np.diff(self.labeling_offsets))
        mirrored = _numbers(self._column("labelings").flatten()) + first
        return read_only(np.concatenate([np.arange(len(self.xyz)), mirrored]))

    @cached_property
    def known_ids(self) -> IntArray:
        """Semantic ids of all models, ascending."""
        return np.unique(self.ids)

    def rows_of(self, category: str) -> slice:
        """Rows of a category's models."""
        names = [name for name, _ in self.keys]
        return slice(bisect_left(names, category), bisect_right(names, category))

    def find(self, key: ModelKey) -> int | None:
        """Row of a model; None if there is none."""
        row = bisect_left(self.keys, key)
        return row if row < len(self) and self.keys[row] == key else None

    def model(self, row: int) -> LibraryModel:
        """Make the model of a row."""
        own = slice(int(self.offsets[row]), int(self.offsets[row + 1]))
        category, model_id = self.keys[row]
        path = self.table["mesh"][row].as_py()
        return LibraryModel(
            category=category,
            model_id=model_id,
            xyz=self.xyz[own],
            ids=self.ids[own],
            bounds=self.bounds[row],
            symmetries=_symmetries_from(
                self.table["symmetries"][row].as_py(), own.stop - own.start
            ),
            mesh_path=None if path is None else Path(path),
        )

    def _column(self, name: str) -> Any:
        column = self.table[name]
        return column.chunk(0) if column.num_chunks else pa.array([], type=column.type)


def _library_model(model: object) -> LibraryModel:
    """A library's model; one of a data set is read."""
    if isinstance(model, LibraryModel):
        return model
    if isinstance(model, AnnotatedModel):
        return LibraryModel.of_annotated(model)
    what = f"expected a LibraryModel or a data set's model, got {type(model).__name__}"
    raise InputError(what, where="models", fix="give the models of `cadalign.datasets`")


def read_annotated(model: AnnotatedModel) -> tuple[LibraryModel, str]:
    """A data set's model, and why its bounds are the keypoints' where the mesh cannot be read."""
    try:
        return LibraryModel.of_annotated(model), ""
    except DataError as error:
        return LibraryModel.of_annotated(model, with_mesh=False), str(error)


def row_of(model: LibraryModel) -> dict[str, Any]:
    """Convert a model to a row of the table, its keypoints in the order of their ids."""
    order = np.argsort(model.ids)
    place = np.argsort(order)
    symmetries = model.symmetries
    reflections = [(int(place[a]), int(place[b])) for a, b in symmetries.reflections]
    xyz = model.xyz[order]
    labelings = mirrored_labelings(xyz, reflections)
    rotations = []
    for each in symmetries.rotations:
        circle = each.circle and [
            each.circle.center.tolist(),
            each.circle.radius,
            each.circle.normal.tolist(),
        ]
        rotations.append(
            {"keypoints": [int(place[row]) for row in each.keypoints], "circle": circle}
        )
    return {
        "category": model.category,
        "model_id": model.model_id,
        "mesh": None if model.mesh_path is None else str(model.mesh_path),
        "bounds": model.bounds.ravel().tolist(),
        "keypoints": xyz.tolist(),
        "semantic_ids": model.ids[order].tolist(),
        "labelings": [row for labeling in labelings for row in labeling.tolist()],
        "symmetries": json.dumps({"reflections": reflections, "rotations": rotations}),
    }


def _symmetries_from(text: str, count: int) -> Symmetries:
    """Read a model's symmetries and check their rows of its ``count`` keypoints."""

    def read_circle(center: list[float], radius: float, normal: list[float]) -> Circle:
        return Circle(np.array(center), radius, np.array(normal))

    try:
        data = json.loads(text)
        rotations = tuple(
            RotationalSymmetry(
                tuple(each["keypoints"]),
                None if each["circle"] is None else read_circle(*each["circle"]),
            )
            for each in data["rotations"]
        )
        reflections = tuple((first, second) for first, second in data["reflections"])
    except (ValueError, TypeError, KeyError, IndexError, RecursionError) as error:
        raise DataError(f"malformed ({str(error)[:200]})", where="symmetries") from None
    rows = [row for pair in reflections for row in pair]
    rows += [row for rotation in rotations for row in rotation.keypoints]
    if not all(isinstance(row, int) and 0 <= row < count for row in rows):
        raise DataError("names a keypoint that does not exist", where="symmetries")
    return Symmetries(reflections, rotations)


def _no_symmetries() -> Symmetries:
    return Symmetries()


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
