"""`cadalign library`: build and inspect libraries of CAD models to retrieve from."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.options import make_folder, new_console

if TYPE_CHECKING:
    from cadalign.retrieval import Library


@dataclass(frozen=True)
class LibraryBuild:
    """Build a library of a data set's annotated models, as one file."""

    root: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ROOT")]
    """Folder in KeypointNet's layout."""
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
    """Check a library file and list its models by category."""

    library: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LIBRARY")]
    """File that `cadalign library build` wrote."""

    def run(self) -> int:
        """Open the library and describe it; returns the exit code."""
        from cadalign.retrieval import Library

        new_console(stderr=False).print(_describe(Library.open(self.library)), markup=False)
        return 0


@dataclass(frozen=True)
class LibraryCommand:
    """Build and inspect libraries of CAD models."""

    library: Annotated[
        Annotated[LibraryBuild, tyro.conf.subcommand("build")]
        | Annotated[LibraryShow, tyro.conf.subcommand("show")],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> int:
        """Run the chosen command; returns its exit code."""
        return self.library.run()


def _describe(library: Library) -> str:
    """Count the models of each category."""
    counts = Counter(category for category, _ in library.keys)
    listed = ", ".join(f"{count} {category}" for category, count in sorted(counts.items()))
    return f"{len(library)} models: {listed}"
