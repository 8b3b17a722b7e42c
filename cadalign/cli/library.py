"""`cadalign library`: build and inspect libraries of CAD models to retrieve from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.common import answer, group_of, make_folder_of, say, waiting
from cadalign.cli.options import named_as_flags
from cadalign.errors import refuse_unused
from cadalign.io.files import keeping, refuse_input, require_utf8

if TYPE_CHECKING:
    from cadalign.retrieval import Library


@dataclass(frozen=True)
class LibraryBuild:
    """Build a library of own models, or of a data set's annotated ones, as one file."""

    root: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder of meshes with their NAME.keypoints.json, whose subfolders are categories; or one in
    KeypointNet's layout."""
    out: Path = Path("library.cadalign")
    """File to write."""
    categories: tuple[str, ...] | None = None
    """Categories to include; all by default."""
    split: str | None = None
    """Split of the data set to include, such as train; all models by default."""
    shapenet: Path | None = None
    """Folder of ShapeNetCore, for the meshes, if they are not below the root."""

    def run(self) -> int:
        """Build the library; returns the exit code."""
        from cadalign.datasets import KeypointNet
        from cadalign.retrieval.library import Library, keypoint_files

        for folder in (self.root, self.shapenet):
            if folder is not None:
                require_utf8(folder)
        own = keypoint_files(self.root) if self.root.is_dir() else []
        files: Iterable[Path] = own
        dataset, total = None, len(own)
        if own:
            with named_as_flags(self):
                refuse_unused(self, {"split", "shapenet"}, "on a folder of own models")
        else:
            dataset = KeypointNet(self.root, shapenet_root=self.shapenet)
            dataset = dataset.subset(categories=self.categories, split=self.split)
            files, total = dataset.files, len(dataset.ids())
        with keeping(files), waiting(f"reading {total:,} models"):
            refuse_input(self.out)
            make_folder_of(self.out)
            if dataset is None:
                library = Library.from_folder(self.root, categories=self.categories)
            else:
                library = Library.from_dataset(dataset)
            library.save(self.out)
        megabytes = self.out.stat().st_size / 1e6
        say(f"{_describe(library)}\nWritten: {self.out} ({megabytes:.1f} MB)")
        if dataset is not None and dataset.problems:
            say(f"Left out: {len(dataset.problems)} models with malformed annotations")
        return 0


@dataclass(frozen=True)
class LibraryShow:
    """Check a library file and list its models by category."""

    library: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LIBRARY")]
    """File that `cadalign library build` wrote."""

    def run(self) -> int:
        """Open the library and describe it; returns the exit code."""
        from cadalign.retrieval import Library

        answer(_describe(Library.open(self.library)))
        return 0


def _describe(library: Library) -> str:
    counts = Counter(category for category, _ in library.keys)
    listed = ", ".join(f"{count} {category}" for category, count in sorted(counts.items()))
    without = len(library) - library.with_mesh
    text = f"{len(library)} models: {listed}" + (f"; {without} without a mesh" if without else "")
    return f"{text}\nKeypoints: {', '.join(library.names)}" if library.names else text


LibraryCommand = group_of(
    "Build and inspect libraries of CAD models.",
    {"build": LibraryBuild, "show": LibraryShow},
)
