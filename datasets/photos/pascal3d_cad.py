"""CAD models of PASCAL3D+ and ObjectNet3D: a `.mat` file of each category, with named anchors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.datasets.photos.mat_files import MatStruct, read_structs
from cadalign.datasets.photos.photo import NamedPoints
from cadalign.errors import DataError, InputError
from cadalign.geometry.mesh import Mesh


@dataclass(frozen=True)
class PascalCad:
    """One CAD model of a category.

    Parameters
    ----------
    path : Path
        The category's file, whose variable has the category's name: a struct array with
        ``vertices``, ``faces`` (from 1), ``pnames`` and one field per named anchor. x is lateral,
        y along the length, z up.
    category : str
        The category.
    index : int
        The model's number, from 1 as in the annotations.
    """

    path: Path
    category: str
    index: int

    def load_mesh(self) -> Mesh:
        """Read the mesh."""
        found = self._find()
        where = f"{self.path}: model {self.index}"
        try:
            vertices, faces = found.array("vertices", 3), found.array("faces", 3)
            return Mesh(vertices, faces.astype(np.int64) - 1, source=where)
        except InputError as error:
            raise DataError(error.what, where=f"{where}: {error.where}") from None

    def load_keypoints(self) -> NamedPoints | None:
        """Read the anchors that this model has."""
        found = self._find()
        try:
            anchors = {
                name: found.array(name, 3) for name in found.texts("pnames") if name in found.names
            }
        except InputError as error:
            where = f"{self.path}: model {self.index}: {error.where}"
            raise DataError(error.what, where=where) from None
        present = {name: xyz[0] for name, xyz in anchors.items() if len(xyz) == 1}
        if not present:
            return None
        return NamedPoints(tuple(present), np.array(list(present.values())))

    def _find(self) -> MatStruct:
        models = _models(self.path, self.category)
        if not 1 <= self.index <= len(models):
            what = f"there is no model {self.index}, only {len(models)}"
            raise DataError(what, where=str(self.path))
        return models[self.index - 1]


# A category's file takes a second to read, and all of a category's objects need it.
@lru_cache(maxsize=4)
def _models(path: Path, category: str) -> tuple[MatStruct, ...]:
    return read_structs(path, category)
