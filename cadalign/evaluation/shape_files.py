"""Shape models that runs are given, find or learn, by category.

`ShapeFiles` are given to runs on KeypointNet; `learn` makes `LearnedFiles` of a split of it, with a
library of its models; `shapes_of` are given to runs on photos.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import DataError, InputError, quote
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import fingerprint
from cadalign.io.files import made_folder, read_bytes
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library

logger = logging.getLogger("cadalign")

_SUFFIX = ".shape"


@dataclass(frozen=True)
class ShapeFiles:
    """Files of learned shapes by category; small, so that workers open what they need."""

    paths: tuple[tuple[str, Path], ...]

    @classmethod
    def find(cls, path: Path, categories: Iterable[str]) -> ShapeFiles:
        """Find the shapes of categories in a file or a folder.

        Raises DataError if there is no file, one cannot be read, or two are of one category; and
        InputError if none is of these categories, or a shape's keypoints have names.
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

    def shape(self, category: str) -> ShapeModel:
        """The shape of a category that there is a file of."""
        return _open(dict(self.paths)[category])

    def fingerprint(self) -> str:
        """Hash of the files: a run must not go on with others."""
        parts = ((f"{name}\0", read_bytes(path)) for name, path in self.paths)
        return fingerprint(*(part for pair in parts for part in pair))


NO_SHAPES = ShapeFiles(())


@dataclass(frozen=True)
class LearnedFiles(ShapeFiles):
    """Files of what is learned: shape models by category, and the library of all models."""

    library_file: str

    def library(self) -> Library:
        """The library."""
        return _open_library(self.library_file)

    def fingerprint(self) -> str:
        """Hash of the shape models and the library."""
        parts: list[Any] = [self.library().fingerprint]
        for category, path in self.paths:
            shape = _open(path)
            parts.append(f"{category}\0{shape.inflation!r}\0{shape.degrees_of_freedom!r}\0")
            if shape.few_keypoints is not None:
                parts.append(f"{shape.few_keypoints!r}\0")
            if shape.box_margins is not None:
                parts += [shape.box_margins.margins, shape.box_margins.tolerances]
            parts += _numbers(shape)
        return fingerprint(*parts)


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
        if not _is_readable(file):
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


def _is_readable(file: Path) -> bool:
    """True for a shape model's file of this version; others are learned anew."""
    try:
        ShapeModel.open(file)
    except DataError:
        return False
    return True


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


def shapes_fingerprint(shapes: Sequence[ShapeModel]) -> str:
    """Hash of shape models; empty of none."""
    if not shapes:
        return ""
    parts: list[Any] = []
    for shape in shapes:
        parts += [f"{shape.category}\0{shape.inflation!r}\0{shape.unit}\0", *_numbers(shape)]
    return fingerprint(*parts)


def _numbers(shape: ShapeModel) -> list[Any]:
    return [
        np.append([part.weight, *part.mean.ravel(), *part.modes.ravel()], part.residual_sigma)
        for part in shape.components
    ]
