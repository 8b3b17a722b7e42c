"""Models of a BOP data set: meshes, and the symmetries that `models_info.json` gives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from cadalign.datasets.photos.photo import CadModel, ModelFiles, existing
from cadalign.errors import InputError
from cadalign.geometry.symmetry import Symmetry, SymmetryAxis
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    Point3,
    Positive,
    convert,
    in_file,
    read_json,
    within,
)

INFO = "models_info.json"
_FOLDERS = ("models", "models_eval", "models_cad")
# Model folders may lie beside the scene's tables or up to three folders above them.
_LEVELS = 3
_Sixteen = Annotated[list[Finite], Meta(min_length=16, max_length=16)]


class _Axis(ForeignDocument):
    axis: Point3
    offset: Point3 = (0.0, 0.0, 0.0)


class ModelInfo(ForeignDocument):
    """One model's entry: bounding box, diameter and symmetries [mm]."""

    diameter: Positive | None = None
    min_x: Finite | None = None
    min_y: Finite | None = None
    min_z: Finite | None = None
    size_x: Finite | None = None
    size_y: Finite | None = None
    size_z: Finite | None = None
    symmetries_discrete: list[_Sixteen] = msgspec.field(default_factory=list)
    symmetries_continuous: list[_Axis] = msgspec.field(default_factory=list)

    def symmetry(self) -> Symmetry:
        """The symmetries; discrete ones are 4 x 4 matrices, row by row."""
        motions = np.reshape(self.symmetries_discrete, (-1, 4, 4)).astype(float)
        axes = [
            SymmetryAxis(np.array(each.axis), np.array(each.offset))
            for each in self.symmetries_continuous
        ]
        return Symmetry(motions, tuple(axes))

    def bounds(self) -> np.ndarray[Any, np.dtype[np.float64]] | None:
        """The bounding box's corners, (2, 3) float; None where it is not given."""
        low = (self.min_x, self.min_y, self.min_z)
        size = (self.size_x, self.size_y, self.size_z)
        if None in low or None in size:
            return None
        corner = np.array(low, dtype=float)
        return np.array([corner, corner + np.array(size, dtype=float)])


@dataclass(frozen=True)
class BopModels:
    """The models' folder of a data set.

    Parameters
    ----------
    folder : Path
        The folder of ``obj_000001.ply`` and ``models_info.json``.
    info : dict
        The parsed entries of ``models_info.json`` by the models' ids; empty where it is missing.
    """

    folder: Path
    info: dict[str, Any]

    @classmethod
    def find(cls, scene: Path) -> BopModels | None:
        """Find the models of a scene: beside it, or in one of the three folders above it.

        Raises
        ------
        DataError
            If ``models_info.json`` cannot be read.
        """
        for place in (scene, *scene.parents[:_LEVELS]):
            for name in _FOLDERS:
                folder = place / name
                if not folder.is_dir():
                    continue
                path = folder / INFO
                if not path.is_file():
                    return cls(folder, {})
                with in_file(path):
                    return cls(folder, convert(read_json(path), dict[str, Any]))
        return None

    def model(self, obj_id: int) -> CadModel:
        """The CAD model of an id; its mesh is None where the file is missing."""
        name = f"obj_{obj_id:06d}"
        info = self._entry(obj_id)
        return CadModel(
            name,
            ModelFiles(existing(self.folder / f"{name}.ply")),
            bounds=info.bounds(),
            diameter=info.diameter,
        )

    def symmetry(self, obj_id: int) -> Symmetry:
        """The symmetries of a model.

        Raises
        ------
        DataError
            If a motion is not rigid, or an axis has no direction.
        """
        with in_file(self.folder / INFO), within(str(obj_id)):
            return self._entry(obj_id).symmetry()

    def _entry(self, obj_id: int) -> ModelInfo:
        if str(obj_id) not in self.info:
            return ModelInfo()
        with in_file(self.folder / INFO):
            found = convert(self.info[str(obj_id)], ModelInfo, str(obj_id))
        if not isinstance(found, ModelInfo):
            raise InputError("not a model's entry", where=str(obj_id))
        return found
