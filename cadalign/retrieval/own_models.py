"""A user's own models: a folder of meshes, each with its keypoints beside it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from cadalign.datasets.models.model_keypoints import SUFFIX, ModelKeypoints
from cadalign.errors import DataError
from cadalign.io.files import listed
from cadalign.io.kinds import MESH_ENDINGS
from cadalign.retrieval.models import LibraryModel

logger = logging.getLogger("cadalign")
_FIX = f"`cadalign annotate PHOTO MODEL` marks keypoints, and writes MODEL{SUFFIX}"


def keypoint_files(folder: Path) -> list[Path]:
    """The files of keypoints in a folder and in those below it."""
    return listed(folder, f"**/*{SUFFIX}")


def read_own_models(
    folder: Path,
    *,
    categories: Iterable[str] | None,
    on_model: Callable[[], object],
) -> tuple[list[LibraryModel], dict[str, int]]:
    """A folder's models, and semantic ids by name; see `cadalign.Library.from_folder`.

    Raises
    ------
    DataError
        If there are none, a file cannot be read, or a name has two numbers.
    """
    chosen = None if categories is None else set(categories)
    files = keypoint_files(folder)
    files = [path for path in files if chosen is None or _category(path) in chosen]
    if not files:
        what = "no model with keypoints" + ("" if chosen is None else " of these categories")
        raise DataError(what, where=str(folder), fix=_FIX)
    read = [(path, ModelKeypoints.load(path)) for path in files]
    names = _numbers(read)
    models = []
    for path, found in read:
        models.append(_model(path, found, names))
        on_model()
    meshes = [path for path in listed(folder, "**/*") if path.suffix.lower() in MESH_ENDINGS]
    used = {model.mesh_path for model in models}
    unused = [path for path in meshes if path.absolute() not in used]
    if unused and chosen is None:
        said = "%d meshes have no keypoints and are left out, the first is %s; %s"
        logger.warning(said, len(unused), unused[0], _FIX)
    return models, names


def _category(path: Path) -> str:
    return path.absolute().parent.name


def _numbers(read: Sequence[tuple[Path, ModelKeypoints]]) -> dict[str, int]:
    """Semantic ids by name: those of the files where all keypoints have one, else by the names."""
    entries = [(path, each) for path, found in read for each in found.keypoints]
    if any(each.semantic_id is None for _, each in entries):
        return {name: k for k, name in enumerate(sorted({each.name for _, each in entries}))}
    names: dict[str, int] = {}
    first: dict[str, Path] = {}
    for path, each in entries:
        number, before = each.semantic_id or 0, first.setdefault(each.name, path)
        if names.setdefault(each.name, number) != number:
            what = f"{each.name!r} has semantic_id {number}, and {names[each.name]} in {before}"
            raise DataError(what, where=str(path), fix="give a name one id, or leave ids out")
    return names


def _model(path: Path, found: ModelKeypoints, names: dict[str, int]) -> LibraryModel:
    stem, mesh = path.name.removesuffix(SUFFIX), found.model
    if mesh is None:
        beside = (path.with_name(stem + suffix) for suffix in MESH_ENDINGS)
        mesh = next((each for each in beside if each.is_file()), None)
    ids = np.array([names[name] for name in found.names], dtype=np.int64)
    return LibraryModel.measured(_category(path), stem, found.xyz, ids, mesh)
