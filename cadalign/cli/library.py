"""`cadalign library`: make libraries of CAD models to retrieve from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.cli.output import make_folder, new_console


@dataclass(frozen=True)
class LibraryBuild:
    """Make a library of a data set's annotated models, as one file."""

    root: Annotated[Path, tyro.conf.Positional]
    """Folder in KeypointNet's layout."""
    out: Path = Path("library.cadalign")
    """File to write."""
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    split: str | None = None
    """The data set's split to take, such as train; all models by default."""
    shapenet: Path | None = None
    """ShapeNetCore, for the meshes, if they are not below the root."""

    def run(self) -> int:
        """Build the library; returns the exit code."""
        from cadalign.datasets import KeypointNet
        from cadalign.retrieval import Library

        console = new_console()
        dataset = KeypointNet(self.root, shapenet_root=self.shapenet)
        dataset = dataset.subset(categories=self.categories, split=self.split)
        with console.status("reading annotations and meshes"):
            library = Library.from_dataset(dataset)
        make_folder(self.out.absolute().parent)
        library.save(self.out)
        megabytes = self.out.stat().st_size / 1e6
        console.print(
            f"{_describe(library)}\nWritten: {self.out} ({megabytes:.1f} MB)", markup=False
        )
        left_out = len(dataset.problems)
        if left_out:
            console.print(f"Left out: {left_out} models with malformed annotations", markup=False)
        return 0


@dataclass(frozen=True)
class LibraryShow:
    """Say what a library holds, once its checksum has been compared."""

    library: Annotated[Path, tyro.conf.Positional]
    """File that `cadalign library build` wrote."""

    def run(self) -> int:
        """Open the library and describe it; returns the exit code."""
        from cadalign.retrieval import Library

        new_console(stderr=False).print(_describe(Library.open(self.library)), markup=False)
        return 0


@dataclass(frozen=True)
class LibraryCommand:
    """Make and inspect libraries of CAD models."""

    what: (
        Annotated[LibraryBuild, tyro.conf.subcommand("build")]
        | Annotated[LibraryShow, tyro.conf.subcommand("show")]
    )

    def run(self) -> int:
        """Run what was chosen; returns its exit code."""
        return self.what.run()


def _describe(library: object) -> str:
    """How many models there are of each category, in words."""
    from collections import Counter

    from cadalign.retrieval import Library

    assert isinstance(library, Library)
    counts = Counter(category for category, _ in library.keys)
    listed = ", ".join(f"{count} {category}" for category, count in sorted(counts.items()))
    return f"{len(library)} models: {listed}"
