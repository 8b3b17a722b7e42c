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
    """Finds mesh files below KeypointNet's root or in ShapeNetCore, listing each folder once."""

    def __init__(self, root: Path, shapenet_root: str | os.PathLike[str] | None) -> None:
        self._ply_folder = root / _PLY_FOLDER
        self._given = [] if shapenet_root is None else [ShapeNet(shapenet_root)]
        below = [root / name for name in _SHAPENET_FOLDERS]
        self._below = [ShapeNet(folder) for folder in below if folder.is_dir()]
        self._listings: dict[str, tuple[dict[str, Path], ...]] = {}

    def paths(self, synset: str, model_id: str) -> tuple[Path, ...]:
        """All mesh files of a model: of the given ShapeNetCore, KeypointNet's, of those below."""
        if synset not in self._listings:
            self._listings[synset] = (
                *(_list_models(shapenet, synset) for shapenet in self._given),
                _list_ply(self._ply_folder / synset),
                *(_list_models(shapenet, synset) for shapenet in self._below),
            )
        return tuple(paths[model_id] for paths in self._listings[synset] if model_id in paths)


def _list_models(shapenet: ShapeNet, synset: str) -> dict[str, Path]:
    name = name_of_synset(synset)
    models = shapenet[name] if name in shapenet.categories else ()
    return {model.model_id: model.mesh_path for model in models}


def _list_ply(folder: Path) -> dict[str, Path]:
    try:
        names = os.listdir(folder)
    except OSError:
        names = []
    return {name.removesuffix(".ply"): folder / name for name in names if name.endswith(".ply")}
