"""Things learned of the categories: shape models and a library, kept in a run's folder."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import DataError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.files import writing
from cadalign.retrieval.library import Library
from cadalign.retrieval.models import LibraryModel
from cadalign.shapes.model import ShapeModel

logger = logging.getLogger("cadalign")


@dataclass(frozen=True)
class LearnedFiles:
    """Files of what is learned: shape models by category, and the library of all models."""

    shapes: tuple[tuple[str, str], ...]
    library: str

    def shape(self, category: str) -> ShapeModel:
        """The shape model of a category."""
        return _open_shape(dict(self.shapes)[category])

    def opened_library(self) -> Library:
        """The library."""
        return _open_library(self.library)

    def fingerprint(self) -> str:
        """Hash of the shape models and the library."""
        digest = hashlib.sha256(self.opened_library().fingerprint.encode())
        for category, path in self.shapes:
            shape = _open_shape(path)
            digest.update(
                f"{category}\0{shape.inflation!r}\0{shape.degrees_of_freedom!r}\0".encode()
            )
            if shape.few_keypoints is not None:
                digest.update(f"{shape.few_keypoints!r}\0".encode())
            if shape.box_margins is not None:
                digest.update(shape.box_margins.margins.tobytes())
                digest.update(shape.box_margins.tolerances.tobytes())
            for part in shape.components:
                numbers = [part.weight, *part.mean.ravel(), *part.modes.ravel()]
                digest.update(np.append(numbers, part.residual_sigma).tobytes())
        return digest.hexdigest()[:16]


def learn(
    dataset: KeypointNet, categories: Sequence[str], *, split: str, folder: RunFolder
) -> LearnedFiles:
    """Learn from the models of a split, or find in a folder what was learned from them before.

    Boxes are those of the keypoints. Files are named after a hash of their models, so that those
    of other models are neither used nor overwritten.

    Raises
    ------
    InputError
        If there is no such split, or a category has too few models in it.
    """
    train = dataset.subset(categories=categories, split=split)
    folder.make()
    place = folder.path / "learned"
    with writing(place):
        place.mkdir(exist_ok=True)
    shapes = []
    for category in categories:
        file = place / f"{category}-{_hash(train[category])}.shape"
        if not _is_readable(file):
            logger.info("learning the shape of %s from %d models", category, len(train[category]))
            ShapeModel.from_dataset(dataset, category, split=split, meshes=False).save(file)
        shapes.append((category, str(file.absolute())))
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


def _hash(models: Sequence[AnnotatedModel]) -> str:
    digest = hashlib.sha256()
    for model in models:
        digest.update(model.model_id.encode() + b"\0")
        digest.update(model.keypoints.xyz.tobytes() + model.keypoints.semantic_ids.tobytes())
    return digest.hexdigest()[:16]


def _is_readable(file: Path) -> bool:
    """True for a shape model's file of this version; others are learned anew."""
    try:
        ShapeModel.open(file)
    except DataError:
        return False
    return True


@lru_cache(maxsize=32)
def _open_shape(path: str) -> ShapeModel:
    return ShapeModel.open(path)


@lru_cache(maxsize=2)
def _open_library(path: str) -> Library:
    return Library.open(path)
