"""Shape models that runs are given, find or learn, by category.

`ShapeFiles` are given to runs on KeypointNet; `learn` makes `LearnedFiles` of a split of it, with a
library of its models; `shapes_of` are given to runs on photos, or found in the data set's folder.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.datasets.photos.kitti_keypoints import car_shape
from cadalign.errors import DataError, InputError, quote
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.io.files import read_bytes, writing
from cadalign.shapes.model import ShapeModel

_SUFFIX = ".shape"


@dataclass(frozen=True)
class ShapeFiles:
    """Files of learned shapes by category; small, so that workers open what they need."""

    paths: tuple[tuple[str, Path], ...]

    @classmethod
    def find(cls, path: Path, categories: Iterable[str]) -> ShapeFiles:
        """Find the shapes of categories in a file or a folder.

        Raises
        ------
        DataError
            If there is no file, one cannot be read, or two are of one category.
        InputError
            If none is of these categories, or a shape's keypoints have names.
        """
        files = sorted(path.glob(f"*{_SUFFIX}")) if path.is_dir() else [path]
        if not files:
            fix = "write them with `cadalign shape learn`"
            raise DataError(f"the folder has no {_SUFFIX} files", where=str(path), fix=fix)
        found: dict[str, Path] = {}
        for file in files:
            shape = ShapeModel.open(file)
            if shape.category in found:
                what = f"of the category {shape.category}, as {found[shape.category].name}"
                raise DataError(what, where=str(file), fix="keep one file for each category")
            if isinstance(shape.ids[0], str):
                what = "its keypoints have names, those of the data set semantic ids"
                raise InputError(what, where=str(file), fix="learn it from the data set")
            found[shape.category] = file.absolute()
        wanted = set(categories)
        used = tuple((name, file) for name, file in found.items() if name in wanted)
        if not used:
            raise InputError(
                f"has shapes of {', '.join(found)}; the run is on {', '.join(sorted(wanted))}",
                where=str(path),
                fix="give the shape of one of the run's categories",
            )
        return cls(used)

    def shape(self, category: str) -> ShapeModel | None:
        """The shape of a category, None where there is none."""
        path = dict(self.paths).get(category)
        return None if path is None else _open(path)

    def fingerprint(self) -> str:
        """Hash of the files: a run must not go on with others."""
        digest = hashlib.sha256()
        for name, path in self.paths:
            digest.update(name.encode() + b"\0" + read_bytes(path))
        return digest.hexdigest()[:16]


NO_SHAPES = ShapeFiles(())


@lru_cache(maxsize=32)
def _open(path: Path | str) -> ShapeModel:
    return ShapeModel.open(path)


if TYPE_CHECKING:
    from cadalign.retrieval.library import Library

logger = logging.getLogger("cadalign")


@dataclass(frozen=True)
class LearnedFiles:
    """Files of what is learned: shape models by category, and the library of all models."""

    shapes: tuple[tuple[str, str], ...]
    library: str

    def shape(self, category: str) -> ShapeModel:
        """The shape model of a category."""
        return _open(dict(self.shapes)[category])

    def opened_library(self) -> Library:
        """The library."""
        return _open_library(self.library)

    def fingerprint(self) -> str:
        """Hash of the shape models and the library."""
        digest = hashlib.sha256(self.opened_library().fingerprint.encode())
        for category, path in self.shapes:
            shape = _open(path)
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
    # Only here: runs that are given their shapes do without retrieval.
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.models import LibraryModel

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


@lru_cache(maxsize=2)
def _open_library(path: str) -> Library:
    from cadalign.retrieval.library import Library

    return Library.open(path)


def shapes_of(files: Sequence[Path], folder: Path) -> tuple[ShapeModel, ...]:
    """The shape models of some files, and of the folder for a category that they lack.

    Raises
    ------
    InputError
        If two files are of the same category.
    DataError
        If one cannot be read.
    """
    given = [ShapeModel.open(path) for path in files]
    counts = Counter(each.category for each in given)
    twice = next((name for name, count in counts.items() if count > 1), None)
    if twice is not None:
        what, fix = f"two files are of the category {quote(twice)}", "give one for each category"
        raise InputError(what, where="shape", fix=fix)
    found = car_shape(folder)
    if found is not None and found.category not in counts:
        given.append(found)
    return tuple(given)


def shapes_fingerprint(shapes: Sequence[ShapeModel]) -> str:
    """Hash of shape models; empty of none."""
    if not shapes:
        return ""
    digest = hashlib.sha256()
    for shape in shapes:
        digest.update(f"{shape.category}\0{shape.inflation!r}\0{shape.unit}\0".encode())
        for part in shape.components:
            numbers = [part.weight, *part.mean.ravel(), *part.modes.ravel()]
            digest.update(np.append(numbers, part.residual_sigma).tobytes())
    return digest.hexdigest()[:16]
