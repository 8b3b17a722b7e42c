"""Mesh files of KeypointNet's models: its own PLY files, or ShapeNet's OBJ files."""

from __future__ import annotations

import os
from pathlib import Path

from cadalign.datasets.models.categories import name_of_synset
from cadalign.datasets.models.shapenet import ShapeNet

_PLY_FOLDER = "ShapeNetCore.v2.ply"
# Folders in ShapeNet's layout that may lie below KeypointNet's root.
_SHAPENET_FOLDERS = ("models", "ShapeNetCore.v2")


class MeshLocator:
    """Finds mesh files, listing each folder of a synset once.

    Parameters
    ----------
    root : Path
        KeypointNet's root.
    shapenet_root : str or path-like, optional
        ShapeNetCore; its meshes come first.
    """

    def __init__(self, root: Path, shapenet_root: str | os.PathLike[str] | None) -> None:
        self._ply_folder = root / _PLY_FOLDER
        self._given = [] if shapenet_root is None else [ShapeNet(shapenet_root)]
        below = [root / name for name in _SHAPENET_FOLDERS]
        self._below = [ShapeNet(folder) for folder in below if folder.is_dir()]
        self._ply_ids: dict[str, frozenset[str]] = {}
        self._obj_paths: dict[tuple[str, str], tuple[dict[str, Path], ...]] = {}

    def paths(self, synset: str, model_id: str) -> tuple[Path, ...]:
        """All mesh files of a model, the preferred one first."""
        found = self._in_shapenets("given", self._given, synset, model_id)
        if model_id in self._list_ply(synset):
            found.append(self._ply_folder / synset / f"{model_id}.ply")
        found += self._in_shapenets("below", self._below, synset, model_id)
        return tuple(found)

    def _in_shapenets(
        self, group: str, shapenets: list[ShapeNet], synset: str, model_id: str
    ) -> list[Path]:
        if (group, synset) not in self._obj_paths:
            name = name_of_synset(synset)
            self._obj_paths[group, synset] = tuple(
                {model.model_id: model.mesh_path for model in shapenet[name]}
                for shapenet in shapenets
                if name in shapenet.categories
            )
        listings = self._obj_paths[group, synset]
        return [listing[model_id] for listing in listings if model_id in listing]

    def _list_ply(self, synset: str) -> frozenset[str]:
        if synset not in self._ply_ids:
            try:
                names = os.listdir(self._ply_folder / synset)
            except OSError:
                names = []
            self._ply_ids[synset] = frozenset(
                name.removesuffix(".ply") for name in names if name.endswith(".ply")
            )
        return self._ply_ids[synset]
