"""KeypointNet: CAD models of ShapeNetCore with semantic keypoints on their surfaces.

You et al., "KeypointNet: A Large-scale 3D Keypoint Dataset Aggregated from Numerous Human
Annotations", CVPR 2020.
"""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from cadalign.datasets.keypoints import (
    Keypoints,
    Symmetries,
    annotated_symmetry,
    entry_id,
    parse_entry,
)
from cadalign.datasets.records import read_list
from cadalign.datasets.shapenet import (
    MESH_FILES,
    ShapeNet,
    name_of_synset,
    require_category,
    synset_of_name,
)
from cadalign.errors import DataError, InputError, quote, unknown_name
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.files import as_path, list_folder, read_text
from cadalign.io.meshes.files import load_mesh

logger = logging.getLogger("cadalign")

ModelKey = tuple[str, str]
"""A category's name and a model's id."""

# Folders of meshes below the root: KeypointNet's PLY files, and folders in ShapeNet's layout.
_PLY_FOLDER, _SHAPENET_FOLDERS = "ShapeNetCore.v2.ply", ("models", "ShapeNetCore.v2")
# KeypointNet's file of all categories, beside the files per category.
_ALL = "all"
# Real annotations match their meshes to 1e-6 of a model with the diagonal 1.
_MATCH_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class AnnotatedModel:
    """One model of KeypointNet."""

    category: str
    """The category's name, such as "chair"."""
    class_id: str
    """The category's synset id, such as "03001627"."""
    model_id: str
    """The model's id."""
    keypoints: Keypoints
    """The annotated points."""
    symmetries: Symmetries
    """The annotated symmetries of the points."""
    mesh_path: Path | None
    """The mesh file, or None."""

    @property
    def key(self) -> ModelKey:
        """(category, model id)"""
        return self.category, self.model_id

    @property
    def symmetry(self) -> Symmetry:
        """The rotations that map the model onto itself, derived from its annotation."""
        return annotated_symmetry(self.keypoints.xyz, self.symmetries)

    def load_mesh(self, *, check: bool = True) -> Mesh:
        """Read the mesh.

        Parameters
        ----------
        check : bool
            Whether to check that the keypoints lie at their annotated places on the mesh, within
            1e-3 of its diagonal. Meshes of another version of ShapeNet fail this check.

        Raises
        ------
        DataError
            If the mesh is missing, cannot be read, or fails the check.
        """
        where = f"{self.category}, model {self.model_id}"
        if self.mesh_path is None:
            fix = "get KeypointNet's ShapeNetCore.v2.ply, or give shapenet_root"
            raise DataError("there is no mesh of this model", where=where, fix=fix)
        mesh = load_mesh(self.mesh_path)
        if not check:
            return mesh
        given, fix = self.keypoints, "give ShapeNetCore.v2's mesh, or load this with check=False"
        try:
            rebuilt = mesh.surface_points(given.face_index, given.barycentric)
        except InputError as error:
            raise DataError(error.what, where=where, fix=fix) from None
        gaps = np.linalg.norm(rebuilt - given.xyz, axis=1)
        worst = int(np.argmax(gaps))
        low, high = mesh.bounds
        # "not <=" also refuses NaN, which a damaged mesh can give.
        if not gaps[worst] <= _MATCH_TOLERANCE * np.linalg.norm(high - low):
            raise DataError(
                f"keypoints[{worst}] lies {gaps[worst]:.3g} from the point that its face and "
                f"barycentric coordinates give in {mesh.source}",
                where=where,
                fix=fix,
            )
        return mesh


# A category's models by id, in file order; an error for each that could not be read.
_Models = dict[str, AnnotatedModel | DataError]


class KeypointNet:
    """The annotated models below a folder in KeypointNet's layout.

    ::

        annotations/<category>.json
        splits/<name>.txt               lines <synset>-<model id>
        ShapeNetCore.v2.ply/<synset>/<model id>.ply                          meshes, either here
        models/<synset>/<model id>/models/model_normalized.obj               or here

    A category is read on first access, a mesh when `AnnotatedModel.load_mesh` is called.
    Categories are sorted, models are in file order.

    Models with a malformed annotation are skipped with a warning (logger "cadalign") by iteration,
    ``len`` and ``dataset["chair"]``. `problems` holds their errors, and `ids` includes them.
    Access by id raises the error.

    Parameters
    ----------
    root : str or path-like
        The folder.
    shapenet_root : str or path-like, optional
        ShapeNetCore's folder; its meshes take precedence over those below ``root``. KeypointNet
        was annotated on version 2; version 1 has other faces and coordinates.

    Raises
    ------
    DataError
        If the folder is missing or has no annotations.

    Examples
    --------
    >>> dataset = KeypointNet("keypointnet")  # doctest: +SKIP
    >>> for model in dataset.subset(categories=["chair"], split="test", with_mesh=True):
    ...     print(model.model_id, len(model.keypoints))  # doctest: +SKIP
    >>> dataset["chair", "88382b877be91b2a572f8e1c1caad99e"].load_mesh()  # doctest: +SKIP
    """

    def __init__(
        self, root: str | os.PathLike[str], *, shapenet_root: str | os.PathLike[str] | None = None
    ) -> None:
        self.root = as_path(root, "root")
        if not self.root.is_dir():
            raise DataError("no such folder", where=str(self.root), fix="give KeypointNet's root")
        given = [] if shapenet_root is None else [ShapeNet(shapenet_root).root]
        below = (self.root / name for name in _SHAPENET_FOLDERS)
        # Possible paths of a mesh: the parts before and after <synset>/<model id>.
        self._mesh_places = [
            *((folder, f"/{file}") for folder in given for file in MESH_FILES),
            (self.root / _PLY_FOLDER, ".ply"),
            *((folder, f"/{file}") for folder in below for file in MESH_FILES),
        ]
        self._allowed: frozenset[ModelKey] | None = None
        self._with_mesh = False
        folder = self.root / "annotations"
        self._files = {
            path.stem: path for path in list_folder(folder, "*.json") if path.stem != _ALL
        }
        if not self._files:
            fix = "give the folder that holds KeypointNet's annotations/ and splits/"
            raise DataError("no annotations/*.json below it", where=str(self.root), fix=fix)
        self._loaded: dict[str, _Models] = {}
        self.categories = tuple(sorted(self._files))
        """The categories' names, sorted."""

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits, sorted."""
        return tuple(path.stem for path in list_folder(self.root / "splits", "*.txt"))

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of the annotation and split files."""
        folders = (self.root / "annotations", "*.json"), (self.root / "splits", "*.txt")
        return tuple(path for folder, ending in folders for path in folder.glob(ending))

    def split(self, name: str) -> frozenset[ModelKey]:
        """Read the (category, model id) listed in a split, with or without annotation.

        Raises
        ------
        InputError
            If the split does not exist.
        DataError
            If a line of its file is not ``<synset>-<model id>``.
        """
        if name not in self.splits:
            raise unknown_name("split", name, self.splits, where=str(self.root / "splits"))
        path, members = self.root / "splits" / f"{name}.txt", set()
        for number, line in enumerate(read_text(path, errors="replace").splitlines(), start=1):
            synset, _, model_id = line.strip().partition("-")
            if synset and model_id:
                members.add((name_of_synset(synset), model_id))
            elif line.strip():
                what = f"{quote(line.strip())} is not <synset>-<model id>"
                raise DataError(what, where=f"{path}, line {number}")
        return frozenset(members)

    def subset(
        self,
        *,
        categories: Iterable[str] | None = None,
        split: str | None = None,
        with_mesh: bool = False,
    ) -> KeypointNet:
        """Select some of the models; the subset shares the data already read.

        Parameters
        ----------
        categories : iterable of str, optional
            Names or synset ids; by default all categories.
        split : str, optional
            A split's name; by default all models.
        with_mesh : bool
            Whether to select only models with a mesh file.

        Raises
        ------
        InputError
            If a category or the split is unknown.
        """
        chosen = copy.copy(self)
        if categories is not None:
            names = [categories] if isinstance(categories, str) else categories
            chosen.categories = tuple(sorted({self._require(name) for name in names}))
        if split is not None:
            members = self.split(split)
            chosen._allowed = members if self._allowed is None else self._allowed & members
        chosen._with_mesh = self._with_mesh or with_mesh
        return chosen

    def ids(self, category: str | None = None) -> tuple[ModelKey, ...]:
        """List the (category, model id) of one category or all, with malformed models.

        An entry without a model id is named by its position: ``("chair", "#17")``.
        """
        names = self.categories if category is None else (self._require(category),)
        return tuple((name, model_id) for name in names for model_id in self._models(name))

    @property
    def problems(self) -> dict[ModelKey, DataError]:
        """Errors of the models that could not be read, by (category, model id)."""
        return {
            (name, model_id): found
            for name in self.categories
            for model_id, found in self._models(name).items()
            if isinstance(found, DataError)
        }

    @overload
    def __getitem__(self, key: str) -> tuple[AnnotatedModel, ...]: ...
    @overload
    def __getitem__(self, key: ModelKey) -> AnnotatedModel: ...
    def __getitem__(self, key: str | ModelKey) -> AnnotatedModel | tuple[AnnotatedModel, ...]:
        """``dataset["chair"]``: a category's models; ``dataset["chair", model_id]``: one.

        Raises
        ------
        InputError
            If the category or model does not exist.
        DataError
            If the category's file or the model's annotation is malformed.
        """
        if not isinstance(key, tuple):
            models = self._models(self._require(key)).values()
            return tuple(model for model in models if isinstance(model, AnnotatedModel))
        name, model_id = self._require(key[0]), key[1]
        found = self._load(name).get(model_id)
        if isinstance(found, DataError):
            # A copy: a raised error keeps its stack frames alive.
            raise copy.copy(found)
        if found is None or not self._has(name, model_id):
            raise InputError(f"no model {model_id!r} of {name!r}", where=str(self.root))
        return found

    def __iter__(self) -> Iterator[AnnotatedModel]:
        for category in self.categories:
            yield from self[category]

    def __len__(self) -> int:
        return sum(len(self[category]) for category in self.categories)

    def __repr__(self) -> str:
        return f"KeypointNet({str(self.root)!r}, categories={list(self.categories)})"

    def _require(self, category: str) -> str:
        return require_category(category, self.categories, where=str(self.root))

    def _models(self, category: str) -> _Models:
        models = self._load(category).items()
        return {model_id: found for model_id, found in models if self._has(category, model_id)}

    def _has(self, category: str, model_id: str) -> bool:
        if self._allowed is not None and (category, model_id) not in self._allowed:
            return False
        if not self._with_mesh:
            return True
        found = self._load(category).get(model_id)
        if isinstance(found, AnnotatedModel):
            return found.mesh_path is not None
        return self._mesh_path(synset_of_name(category), model_id) is not None

    def _mesh_path(self, synset: str, model_id: str) -> Path | None:
        paths = (f"{folder}/{synset}/{model_id}{end}" for folder, end in self._mesh_places)
        return next((Path(path) for path in paths if os.path.isfile(path)), None)

    def _load(self, category: str) -> _Models:
        """Read all models of a category, once for the data set and its subsets."""
        if category in self._loaded:
            return self._loaded[category]
        path, models = self._files[category], dict[str, AnnotatedModel | DataError]()
        for position, entry in enumerate(read_list(path)):
            model_id = entry_id(entry, position)
            where = f"{path.name}, model {model_id}"
            try:
                if model_id in models:
                    model_id = f"{model_id}#{position}"
                    raise DataError("the model occurs twice", where=where, fix="remove one entry")
                annotation = parse_entry(entry, where=where)
                mesh_path = self._mesh_path(*annotation[:2])
                models[model_id] = AnnotatedModel(category, *annotation, mesh_path)
            except DataError as error:
                logger.warning("left out: %s", error)
                models[model_id] = error.with_traceback(None)
        self._loaded[category] = models
        return models
