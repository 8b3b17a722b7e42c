"""ShapeNetCore: categories with their WordNet synset ids, and models in its folder layout."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import overload

from cadalign.errors import DataError, InputError, unknown_name
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import as_path
from cadalign.io.meshes.files import load_mesh

SYNSETS: dict[str, str] = {
    "airplane": "02691156", "bag": "02773838", "basket": "02801938", "bathtub": "02808440",
    "bed": "02818832", "bench": "02828884", "birdhouse": "02843684", "bookshelf": "02871439",
    "bottle": "02876657", "bowl": "02880940", "bus": "02924116", "cabinet": "02933112",
    "camera": "02942699", "can": "02946921", "cap": "02954340", "car": "02958343",
    "cellphone": "02992529", "chair": "03001627", "clock": "03046257", "dishwasher": "03207941",
    "display": "03211117", "earphone": "03261776", "faucet": "03325088",
    "file cabinet": "03337140", "flowerpot": "03991062", "guitar": "03467517",
    "helmet": "03513137", "jar": "03593526", "keyboard": "03085013", "knife": "03624134",
    "lamp": "03636649", "laptop": "03642806", "loudspeaker": "03691459", "mailbox": "03710193",
    "microphone": "03759954", "microwave": "03761084", "motorcycle": "03790512",
    "mug": "03797390", "piano": "03928116", "pillow": "03938244", "pistol": "03948459",
    "printer": "04004475", "remote": "04074963", "rifle": "04090263", "rocket": "04099429",
    "skateboard": "04225987", "sofa": "04256520", "stove": "04330267", "table": "04379243",
    "telephone": "04401088", "tower": "04460130", "train": "04468005", "trash bin": "02747177",
    "vessel": "04530566", "washer": "04554684",
}  # fmt: skip
"""Synset ids of ShapeNetCore's categories by name; KeypointNet's names where it has them."""

# Path of the mesh in a model's folder: version 2, then version 1.
MESH_FILES = (Path("models", "model_normalized.obj"), Path("model.obj"))
_SYNSET_DIGITS = 8
_NAMES = {synset: name for name, synset in SYNSETS.items()}


def name_of_synset(synset: str) -> str:
    """Return the category's name; a synset id that is not ShapeNetCore's is returned unchanged."""
    return _NAMES.get(synset, synset)


def synset_of_name(name: str) -> str:
    """Return the category's synset id; an unknown name is returned unchanged."""
    return SYNSETS.get(name, name)


def require_category(name: str, known: Iterable[str], *, where: str) -> str:
    """Return the name of a category, given by name or synset id; it must be in ``known``."""
    names = sorted(known)
    for candidate in (name, name_of_synset(name)):
        if candidate in names:
            return candidate
    raise unknown_name("category", name, names, where=where)


@dataclass(frozen=True)
class ShapeNetModel:
    """One model of ShapeNetCore."""

    category: str
    """The category's name, such as "chair"."""
    class_id: str
    """The category's synset id, such as "03001627"."""
    model_id: str
    """The model's id."""
    mesh_path: Path
    """Its OBJ file."""

    def load_mesh(self) -> Mesh:
        """Read the mesh; see `cadalign.load_mesh`."""
        return load_mesh(self.mesh_path)


class ShapeNet:
    """The models of ShapeNetCore, version 1 or 2.

    Meshes are ``<synset>/<model id>/model.obj`` (version 1) or
    ``<synset>/<model id>/models/model_normalized.obj`` (version 2, preferred if both exist).
    A category's folder is listed on first access.

    Parameters
    ----------
    root : str or path-like
        The folder that holds the synsets' folders.

    Raises
    ------
    DataError
        If the folder is missing.

    Examples
    --------
    >>> shapenet = ShapeNet("ShapeNetCore.v2")  # doctest: +SKIP
    >>> shapenet.categories  # doctest: +SKIP
    ('airplane', 'bag', ...)
    >>> mesh = shapenet["chair", "88382b877be91b2a572f8e1c1caad99e"].load_mesh()  # doctest: +SKIP
    """

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = as_path(root, "root")
        if not self.root.is_dir():
            raise DataError("no such folder", where=str(self.root), fix="give ShapeNetCore's root")
        self._models: dict[str, dict[str, ShapeNetModel]] = {}

    @cached_property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories that have a folder, sorted; unknown synsets keep their id."""
        folders = [entry.name for entry in os.scandir(self.root) if entry.is_dir()]
        synsets = [name for name in folders if name.isdigit() and len(name) == _SYNSET_DIGITS]
        return tuple(sorted(map(name_of_synset, synsets)))

    @overload
    def __getitem__(self, key: str) -> tuple[ShapeNetModel, ...]: ...
    @overload
    def __getitem__(self, key: tuple[str, str]) -> ShapeNetModel: ...
    def __getitem__(self, key: str | tuple[str, str]) -> ShapeNetModel | tuple[ShapeNetModel, ...]:
        """``shapenet["chair"]``: a category's models; ``shapenet["chair", model_id]``: one."""
        if not isinstance(key, tuple):
            return tuple(self._list(key).values())
        models = self._list(key[0])
        if key[1] not in models:
            raise InputError(f"no model {key[1]!r} of {key[0]!r}", where=str(self.root))
        return models[key[1]]

    def __iter__(self) -> Iterator[ShapeNetModel]:
        for category in self.categories:
            yield from self[category]

    def __len__(self) -> int:
        return sum(len(self._list(category)) for category in self.categories)

    def __repr__(self) -> str:
        return f"ShapeNet({str(self.root)!r})"

    def _list(self, category: str) -> dict[str, ShapeNetModel]:
        name = require_category(category, self.categories, where=str(self.root))
        if name not in self._models:
            synset = synset_of_name(name)
            folder = self.root / synset
            self._models[name] = {
                model_id: ShapeNetModel(name, synset, model_id, folder / model_id / file)
                for model_id in sorted(os.listdir(folder))
                for file in MESH_FILES[::-1]  # version 2 replaces version 1
                if (folder / model_id / file).is_file()
            }
        return self._models[name]
