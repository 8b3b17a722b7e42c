"""Shape models that runs are given or learn, by category, and a library of the same models."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import InputError, quote
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import fingerprint
from cadalign.io.files import made_folder, read_bytes
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library

logger = logging.getLogger("cadalign")


@dataclass(frozen=True)
class LearnedFiles:
    """Files of shape models by category and of a library; small: workers open what they need."""

    paths: tuple[tuple[str, Path], ...]
    library_file: str

    def shape(self, category: str) -> ShapeModel:
        """The shape model of a category."""
        return _open(dict(self.paths)[category])

    def library(self) -> Library:
        """The library."""
        return _open_library(self.library_file)

    def fingerprint(self) -> str:
        """Hash of the shape models and the library."""
        return fingerprint(
            self.library().fingerprint, *(read_bytes(path) for _, path in self.paths)
        )


def learn(
    dataset: KeypointNet, categories: Sequence[str], *, split: str, folder: RunFolder
) -> LearnedFiles:
    """Learn from the models of a split, or find in a folder what was learned from them before.

    Boxes are those of the keypoints. Files are named after a hash of their models, so that those
    of other models are neither used nor overwritten.

    Raises InputError if there is no such split, or a category has too few models in it.
    """
    # Only here: runs that are given their shapes do without retrieval.
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.models import LibraryModel

    train = dataset.subset(categories=categories, split=split)
    folder.make()
    place = made_folder(folder.path / "learned")
    shapes = []
    for category in categories:
        file = place / f"{category}-{_hash_of_models(train[category])}.shape"
        if not file.is_file():
            logger.info("learning the shape of %s from %d models", category, len(train[category]))
            ShapeModel.from_dataset(dataset, category, split=split, meshes=False).save(file)
        shapes.append((category, file.absolute()))
    models = [
        LibraryModel.of_annotated(model, with_mesh=False)
        for category in categories
        for model in train[category]
    ]
    library = Library.from_models(models)
    file = place / f"library-{library.fingerprint[:16]}.cadalign"
    if not file.is_file():
        library.save(file)
    return LearnedFiles(tuple(shapes), str(file.absolute()))


def _hash_of_models(models: Sequence[AnnotatedModel]) -> str:
    keypoints = ((each.model_id, each.keypoints) for each in models)
    return fingerprint(*(part for name, k in keypoints for part in (f"{name}\0", k.xyz, k.ids)))


@lru_cache(maxsize=32)
def _open(path: Path) -> ShapeModel:
    return ShapeModel.open(path)


@lru_cache(maxsize=2)
def _open_library(path: str) -> Library:
    from cadalign.retrieval.library import Library

    return Library.open(path)


def shapes_of(files: Sequence[Path]) -> tuple[ShapeModel, ...]:
    """The shape models of some files.

    Raises InputError if two files are of the same category; and DataError if one cannot be read.
    """
    given = [ShapeModel.open(path) for path in files]
    counts = Counter(each.category for each in given)
    twice = next((name for name, count in counts.items() if count > 1), None)
    if twice is not None:
        what, fix = f"two files are of the category {quote(twice)}", "give one for each category"
        raise InputError(what, where="shape", fix=fix)
    return tuple(given)
