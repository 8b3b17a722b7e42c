"""A model's keypoints with their names, as a file beside the model: `chair.keypoints.json`.

The file holds one object::

    {
      "format": "cadalign model keypoints",
      "version": 1,
      "model": "chair.obj",
      "keypoints": [
        {"name": "seat, front left", "xyz": [0.17, 0.02, 0.21], "semantic_id": 3,
         "face_index": 118, "barycentric": [0.2, 0.3, 0.5]},
        {"name": "back, top left", "xyz": [0.16, 0.44, -0.19]},
        {"name": "arm rest, left", "face_index": 52, "barycentric": [0.1, 0.1, 0.8]}
      ]
    }

``name`` is what detectors and people call the keypoint; no name occurs twice. Where it lies is said
by ``xyz`` in model units, or by ``face_index`` (counted as in the mesh file, from 0) and
``barycentric`` (weights of the face's corners in file order), or by both; ``xyz`` counts then.
``semantic_id``, optional, is the keypoint's number within its category; none occurs twice.
``model``, optional, is the mesh file's path, relative to this file; keypoints without ``xyz`` need
it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.meshes.load import load_mesh
from cadalign.datasets.models.keypointnet import AnnotatedModel
from cadalign.errors import CadalignError, DataError
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import write_json
from cadalign.io.json_file import (
    as_index,
    as_numbers,
    as_object,
    as_path,
    as_text,
    in_file,
    read_json,
    refuse_unknown,
    written_path,
)

FORMAT = "cadalign model keypoints"
VERSION = 1
SUFFIX = ".keypoints.json"
"""What the file of ``chair.obj`` ends in: ``chair.keypoints.json``."""

_FIELDS = {"format", "version", "model", "keypoints"}
_KEYPOINT_FIELDS = {"name", "xyz", "semantic_id", "face_index", "barycentric"}
_SUM_TOLERANCE = 0.01


@dataclass(frozen=True)
class ModelKeypoint:
    """One named point on a model.

    Parameters
    ----------
    name : str
        What the point is called.
    xyz : tuple of 3 float
        Where it lies [model units].
    semantic_id : int, optional
        Its number within the model's category.
    face_index : int, optional
        The face that it lies on, counted as in the mesh file.
    barycentric : tuple of 3 float, optional
        Where on that face: weights of its corners in file order, of sum 1.
    """

    name: str
    xyz: tuple[float, float, float]
    semantic_id: int | None = None
    face_index: int | None = None
    barycentric: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class ModelKeypoints:
    """The named keypoints of a model.

    Parameters
    ----------
    keypoints : tuple of ModelKeypoint
    model : Path, optional
        The mesh file.

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

    def __post_init__(self) -> None:
        for field in ("name", "semantic_id"):
            first: dict[object, int] = {}
            for row, keypoint in enumerate(self.keypoints):
                value = getattr(keypoint, field)
                if value is not None and first.setdefault(value, row) != row:
                    raise DataError(
                        f"{value!r} occurs twice, first in keypoints[{first[value]}]",
                        where=f"keypoints[{row}].{field}",
                    )

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def names(self) -> tuple[str, ...]:
        """What the keypoints are called."""
        return tuple(keypoint.name for keypoint in self.keypoints)

    @property
    def semantic_ids(self) -> tuple[int | None, ...]:
        """The keypoints' numbers within the category."""
        return tuple(keypoint.semantic_id for keypoint in self.keypoints)

    @property
    def xyz(self) -> FloatArray:
        """Where the keypoints lie, (k, 3) float [model units]."""
        return np.array([keypoint.xyz for keypoint in self.keypoints], dtype=float).reshape(-1, 3)

    @classmethod
    def of_model(
        cls, model: AnnotatedModel, *, names: Mapping[int, str] | None = None
    ) -> ModelKeypoints:
        """The keypoints of an annotated model.

        Parameters
        ----------
        model : AnnotatedModel
            A model of KeypointNet or of the sample dataset.
        names : mapping of int to str, optional
            By semantic id; "keypoint 3" where there is none.
        """
        given = names or {}
        annotated = model.keypoints
        rows = zip(
            annotated.semantic_ids.tolist(),
            annotated.xyz.tolist(),
            annotated.face_index.tolist(),
            annotated.barycentric.tolist(),
            strict=True,
        )
        return cls(
            tuple(
                ModelKeypoint(
                    given.get(number, f"keypoint {number}"),
                    tuple(xyz),
                    number,
                    face,
                    tuple(weights),
                )
                for number, xyz, face, weights in rows
            ),
            model.mesh_path,
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, mesh: Mesh | None = None) -> ModelKeypoints:
        """Read a file of model keypoints.

        Parameters
        ----------
        path : str or path-like
        mesh : Mesh, optional
            Where keypoints without ``xyz`` lie; the file's ``model`` is read otherwise, if it is
            needed.

        Raises
        ------
        DataError
            If the file is missing, is not JSON, of another format or version, or a field is
            missing, unknown or invalid; the message names file and field.
        """
        path = Path(path)
        data = read_json(path)
        with in_file(path):
            return cls._from_data(data, path.parent, mesh)

    @classmethod
    def _from_data(cls, data: Any, folder: Path, mesh: Mesh | None) -> ModelKeypoints:
        data = as_object(data, where=None)
        if data.get("format") != FORMAT:
            raise DataError(
                f"{data.get('format')!r} is not {FORMAT!r}",
                where="format",
                fix="give a file of model keypoints; see cadalign.datasets.ModelKeypoints",
            )
        if data.get("version") != VERSION:
            raise DataError(
                f"{data.get('version')!r} is not {VERSION}",
                where="version",
                fix="it was written by another version of cadalign",
            )
        refuse_unknown(data, _FIELDS, where="top level")
        entries = data.get("keypoints")
        if not isinstance(entries, list):
            raise DataError("expected a list", where="keypoints")
        model = data.get("model")
        model_path = None if model is None else as_path(model, folder=folder, where="model")
        read = [_read_keypoint(entry, f"keypoints[{row}]") for row, entry in enumerate(entries)]
        floating = [row for row, (_, is_placed) in enumerate(read) if not is_placed]
        keypoints = [keypoint for keypoint, _ in read]
        if floating and mesh is None:
            if model_path is None:
                raise DataError(
                    "neither xyz nor a model that the face belongs to",
                    where=f"keypoints[{floating[0]}]",
                    fix="give xyz, or name the mesh file under model",
                )
            mesh = load_mesh(model_path)
        if mesh is not None:
            for row in floating:
                keypoints[row] = _placed(keypoints[row], mesh, f"keypoints[{row}].face_index")
        return cls(tuple(keypoints), model_path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file of model keypoints; the model's path is written relative to it.

        Raises
        ------
        DataError
            If it cannot be written.
        """
        write_json(Path(path), self.to_dict(folder=Path(path).parent))

    def to_dict(self, *, folder: Path | None = None) -> dict[str, Any]:
        """What the file holds, the model's path relative to ``folder``."""
        data: dict[str, Any] = {"format": FORMAT, "version": VERSION}
        if self.model is not None:
            data["model"] = written_path(self.model.resolve(), folder=folder)
        data["keypoints"] = [_written(keypoint) for keypoint in self.keypoints]
        return data


def _read_keypoint(entry: Any, where: str) -> tuple[ModelKeypoint, bool]:
    """A keypoint, and whether its place is known already."""
    entry = as_object(entry, where=where)
    refuse_unknown(entry, _KEYPOINT_FIELDS, where=where)
    if "name" not in entry:
        raise DataError("missing", where=f"{where}.name")
    xyz = entry.get("xyz")
    face, weights = entry.get("face_index"), entry.get("barycentric")
    if (face is None) != (weights is None):
        missing = "face_index" if face is None else "barycentric"
        raise DataError("missing", where=f"{where}.{missing}", fix="give both or neither")
    if xyz is None and face is None:
        raise DataError("missing", where=f"{where}.xyz", fix="or give face_index and barycentric")
    semantic_id = entry.get("semantic_id")
    keypoint = ModelKeypoint(
        name=as_text(entry["name"], where=f"{where}.name"),
        xyz=_three((0.0, 0.0, 0.0) if xyz is None else xyz, f"{where}.xyz"),
        semantic_id=None
        if semantic_id is None
        else as_index(semantic_id, where=f"{where}.semantic_id"),
        face_index=None if face is None else as_index(face, where=f"{where}.face_index"),
        barycentric=None if weights is None else _weights(weights, f"{where}.barycentric"),
    )
    return keypoint, xyz is not None


def _three(value: Sequence[float], where: str) -> tuple[float, float, float]:
    x, y, z = as_numbers(value, 3, where=where)
    return x, y, z


def _weights(value: Any, where: str) -> tuple[float, float, float]:
    weights = _three(value, where)
    if abs(sum(weights) - 1) > _SUM_TOLERANCE:
        raise DataError(f"{list(weights)} sum to {sum(weights):g}, not to 1", where=where)
    return weights


def _placed(keypoint: ModelKeypoint, mesh: Mesh, where: str) -> ModelKeypoint:
    """The keypoint with the place that its face and barycentric coordinates name."""
    if keypoint.face_index is None or keypoint.barycentric is None:
        return keypoint
    try:
        (xyz,) = mesh.surface_points([keypoint.face_index], [keypoint.barycentric])
    except CadalignError as error:
        raise DataError(error.what, where=where) from None
    return replace(keypoint, xyz=tuple(xyz.tolist()))


def _written(keypoint: ModelKeypoint) -> dict[str, Any]:
    """What the file says of one keypoint."""
    data: dict[str, Any] = {"name": keypoint.name, "xyz": list(keypoint.xyz)}
    if keypoint.semantic_id is not None:
        data["semantic_id"] = keypoint.semantic_id
    if keypoint.face_index is not None and keypoint.barycentric is not None:
        data["face_index"] = keypoint.face_index
        data["barycentric"] = list(keypoint.barycentric)
    return data
