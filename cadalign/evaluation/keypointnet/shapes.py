"""Shape files of a run: the learned shapes of its categories."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from cadalign.errors import DataError, InputError
from cadalign.io.files import read_bytes
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
def _open(path: Path) -> ShapeModel:
    return ShapeModel.open(path)
