"""`cadalign retrieve`: rank a library's models by an image's keypoints; `cadalign library`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.common import (
    answer,
    create_parent,
    group_of,
    print_json,
    print_table,
    say,
    show_status,
)
from cadalign.cli.options import CameraOptions, ManyCommand, name_flags
from cadalign.errors import DataError, refuse_unused
from cadalign.estimation.options import Sigma
from cadalign.io.files import create_folder, protect_inputs, refuse_input, require_utf8
from cadalign.io.images import read_image
from cadalign.io.observation import Observation
from cadalign.retrieval.options import RetrievalOptions
from cadalign.retrieval.query import ObservationRetrieval

if TYPE_CHECKING:
    from cadalign.retrieval import Library
    from cadalign.retrieval.match import Match


@dataclass(frozen=True)
class _RetrievalOptions(RetrievalOptions):
    """Ranking of the models."""

    sigma: tyro.conf.Suppress[Sigma | None] = RetrievalOptions.sigma

    def __post_init__(self) -> None:
        """Skip the checks: `run` makes them, and reports an error in one line."""


@dataclass(frozen=True, kw_only=True)
class Retrieve(ManyCommand, ObservationRetrieval, CameraOptions):
    """Find the models of a library that best explain an image's keypoints.

    Estimates pose and stretch of each model. The observation is a file as for `cadalign fit`. Its
    keypoints need a semantic_id or a name that the library knows, but no xyz; a detector's file
    needs no --model. With --out, writes matches.json, an overlay and an observation of each match,
    and matches.png with all overlays side by side.

    Several observations are a run, as with `cadalign fit`. It writes results.parquet and
    results.csv, with a row per observation, and report.html.
    """

    out: Path | None = None
    """Output folder for matches.json and the pictures; by default nothing is written. For a run,
    the folder of the run; by default beside the observations."""
    picture: bool = True
    """For a run, write report.html."""
    ranking: Annotated[
        _RetrievalOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_RetrievalOptions.__doc__)
    ] = _RetrievalOptions()

    def run(self) -> int:
        """Do the retrieval or the run; returns the exit code."""
        path = self.first
        with name_flags(self, self.ranking):
            how = ObservationRetrieval(
                library=self.library,
                shape=self.shape,
                keypoint_names=self.keypoint_names,
                sigma=self.sigma,
                ranking=RetrievalOptions(**vars(self.ranking)),
            )
            data = self.read_single()
            if data is None:
                from cadalign.batch.retrievals import RetrieveRunOptions  # takes time to import
                from cadalign.cli.runs import inputs_of, run_command

                options = RetrieveRunOptions(estimate=how, **inputs_of(self))
                return run_command(self, options, done="retrieved")
            query = how.read(data, str(path), folder=path.parent, changes=self.changes)
            return self._retrieve(how.resolve_ids(query, str(path)), path, how)

    def _retrieve(self, query: Observation, path: Path, how: ObservationRetrieval) -> int:
        """Retrieve the models of one observation; returns the exit code."""
        from cadalign.retrieval.folder import none_text, write_retrieval

        # Only pictures need the photo: without them it may be missing.
        photo = None
        if self.out is not None and query.image is not None:
            photo = read_image(query.image, query.camera)
        with show_status("retrieving (takes a minute at the first time)"):
            matches = how.retrieve(query, str(path))
        if self.json:
            print_json([match.to_dict() for match in matches])
        else:
            _print_table(matches)
            absent = none_text(matches)
            if absent is not None:
                say(absent)
        if self.out is not None:
            create_folder(self.out)
            with protect_inputs([path, *query.files, self.library]):
                sheet = write_retrieval(self.out, matches, query, image=photo)
            say(f"Pictures: {sheet}")
        return 0


def _print_table(matches: Sequence[Match]) -> None:
    from cadalign.evaluation.summary import ConsoleTable
    from cadalign.retrieval.folder import score_text

    labels = ("", "category", "model")
    heads = ("score", "log-lik.", "rms px", "kpts", "s_y", "s_z", "uncertain")
    rows: list[tuple[str, ...]] = [
        (
            str(rank).rjust(len(str(len(matches)))),
            match.category,
            match.model_id,
            score_text(match.score),
            f"{match.log_likelihood:.1f}",
            f"{match.rms:.2f}",
            match.shared_text,
            *match.stretch_texts,
            ", ".join(match.result.uncertain),
        )
        for rank, match in enumerate(matches, start=1)
    ]
    print_table(ConsoleTable("", labels, heads, rows, grouped=False))


@dataclass(frozen=True)
class LibraryBuild:
    """Build a library file from your own models, or from the models of a data set."""

    root: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder with a subfolder per category that holds meshes and their NAME.keypoints.json; or the
    folder of a data set in KeypointNet's layout."""
    out: Path = Path("library.cadalign")
    """File to write."""
    categories: tuple[str, ...] | None = None
    """Categories of the data set to include; all by default."""
    split: str | None = None
    """Split of the data set to include, such as train; all models by default."""
    shapenet: Path | None = None
    """ShapeNetCore folder with the meshes, if they are not inside FOLDER."""

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
        if own or (self.root.is_dir() and not (self.root / "annotations").is_dir()):
            with name_flags(self):
                unused = {"categories", "split", "shapenet"}
                refuse_unused(self, unused, "on a folder of own models")
        else:
            dataset = KeypointNet(self.root, shapenet_root=self.shapenet)
            dataset = dataset.subset(categories=self.categories, split=self.split)
            files, total = dataset.files, len(dataset.ids())
        with protect_inputs(files), show_status(f"reading {total:,} models"):
            refuse_input(self.out)
            create_parent(self.out)
            if dataset is None:
                library = Library.from_folder(self.root)
            else:
                library = Library.from_models(dataset)
            if not len(library):
                raise DataError("the data set has no such models", where=str(self.root))
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
    """Library file of `cadalign library build`."""

    def run(self) -> int:
        """Open the library and describe it; returns the exit code."""
        from cadalign.retrieval import Library

        answer(_describe(Library.open(self.library)))
        return 0


def _describe(library: Library) -> str:
    counts = Counter(category for category, _ in library.keys)
    listed = ", ".join(f"{count} {category}" for category, count in sorted(counts.items()))
    without = len(library) - library.mesh_count
    text = f"{len(library)} models: {listed}" + (f"; {without} without a mesh" if without else "")
    return f"{text}\nKeypoints: {', '.join(library.names)}" if library.names else text


LibraryCommand = group_of(
    "Build and inspect libraries of CAD models.",
    {"build": LibraryBuild, "show": LibraryShow},
)
