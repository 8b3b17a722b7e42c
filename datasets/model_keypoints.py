"""Named keypoints of a model and their file beside the model, `chair.keypoints.json`.

docs/formats/files.md describes the file.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.keypointnet import AnnotatedModel
from cadalign.errors import DataError, InputError
from cadalign.io.documents import (
    Document,
    Index,
    PathText,
    Point3,
    Text,
    convert,
    name_file,
    path_from,
    read_json,
    require_unique,
    written_path,
)
from cadalign.io.files import as_path, write_json
from cadalign.io.kinds import MESH_ENDINGS, MODEL_KEYPOINTS

if TYPE_CHECKING:
    from cadalign.shapes.model import ShapeModel

SUFFIX = ".keypoints.json"
"""Ending of a keypoint file: ``chair.obj`` has ``chair.keypoints.json``."""

_WANTED = "give a file of model keypoints; see cadalign.datasets.ModelKeypoints"


class _Entry(Document, kw_only=True):
    semantic_id: Index | None = None
    name: Text
    xyz: Point3


class _File(Document):
    format: Literal["cadalign model keypoints"]
    version: Literal[1]
    keypoints: list[_Entry]
    model: PathText | None = None


@dataclass(frozen=True)
class ModelKeypoint:
    """One named point on a model."""

    name: str
    """Name of the point."""
    xyz: tuple[float, float, float]
    """(3,), its position [model units]."""
    semantic_id: int | None = None
    """Its semantic id within the model's category."""


@dataclass(frozen=True)
class ModelKeypoints:
    """The named keypoints of a model.

    Raises
    ------
    DataError
        If a name or a semantic id occurs twice.

    Examples
    --------
    >>> import tempfile
    >>> keypoints = ModelKeypoints((ModelKeypoint("tip", (0.0, 1.0, 0.0), semantic_id=4),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "cone.keypoints.json")
    ...     keypoints.save(path)
    ...     ModelKeypoints.load(path).names
    ('tip',)
    """

    keypoints: tuple[ModelKeypoint, ...]
    model: Path | None = None
    """The mesh file."""

    def __post_init__(self) -> None:
        try:
            require_unique(self.keypoints, "name")
            require_unique(self.keypoints, "semantic_id")
        except InputError as error:
            raise DataError(error.what, where=error.where) from None

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the keypoints."""
        return tuple(keypoint.name for keypoint in self.keypoints)

    @property
    def ids(self) -> tuple[int | None, ...]:
        """Semantic ids of the keypoints; None if it has none."""
        return tuple(keypoint.semantic_id for keypoint in self.keypoints)

    @property
    def xyz(self) -> FloatArray:
        """Positions of the keypoints, (k, 3) float [model units]."""
        return np.array([keypoint.xyz for keypoint in self.keypoints], dtype=float).reshape(-1, 3)

    @classmethod
    def from_model(cls, model: AnnotatedModel) -> ModelKeypoints:
        """Name the keypoints of a KeypointNet model by their ids, such as "keypoint 3"."""
        rows = zip(model.keypoints.ids.tolist(), model.keypoints.xyz.tolist(), strict=True)
        keypoints = (ModelKeypoint(f"keypoint {k}", tuple(xyz), k) for k, xyz in rows)
        return cls(tuple(keypoints), model.mesh_path)

    @classmethod
    def from_shape(cls, shape: ShapeModel) -> ModelKeypoints:
        """Keypoints of a learned shape's mean; one without a name is called "keypoint 3"."""
        labels = shape.names or shape.ids
        names = [each if isinstance(each, str) else f"keypoint {each}" for each in labels]
        numbers = [each if isinstance(each, int) else None for each in shape.ids]
        rows = zip(names, map(tuple, shape.mean.tolist()), numbers, strict=False)
        return cls(tuple(ModelKeypoint(*row) for row in rows))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ModelKeypoints:
        """Read a file of model keypoints.

        Parameters
        ----------
        path : str or path-like
            A file as described in docs/formats/files.md, or a mesh with such a file beside it,
            which is the ``model`` if the file names no other.

        Raises
        ------
        DataError
            If the file is missing, is not JSON, has another format or version, or a field is
            missing, unknown or invalid; the message names file and field.
        """
        path, mesh = as_path(path), None
        if path.suffix.lower() in MESH_ENDINGS and os.path.isfile(path.with_suffix(SUFFIX)):
            path, mesh = path.with_suffix(SUFFIX), path
        data = read_json(path, MODEL_KEYPOINTS)
        if not isinstance(data, dict):
            what = "a list, not an object of model keypoints"
            raise DataError(what, where=str(path), fix=_WANTED)
        with name_file(path):
            read: _File = convert(data, _File)
            model = mesh if read.model is None else path_from(read.model, path.parent)
            keypoints = (ModelKeypoint(e.name, e.xyz, e.semantic_id) for e in read.keypoints)
            return cls(tuple(keypoints), model)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file of model keypoints, with the model's path relative to it.

        Raises
        ------
        DataError
            If the file cannot be written.
        """
        path = as_path(path)
        data: dict[str, Any] = {"format": "cadalign model keypoints", "version": 1}
        if self.model is not None:
            data["model"] = written_path(self.model.resolve(), folder=path.parent)
        written = map(asdict, self.keypoints)
        data["keypoints"] = [{k: v for k, v in each.items() if v is not None} for each in written]
        write_json(path, data)
