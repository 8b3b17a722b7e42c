"""`cadalign retrieve`: rank the models of a library by an image's keypoints."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.common import make_folder, print_json, print_table, say, waiting
from cadalign.cli.options import CameraOptions, ManyCommand, named_as_flags
from cadalign.estimation.options import Sigma
from cadalign.io.documents import read_json
from cadalign.io.files import keeping
from cadalign.io.images import read_image
from cadalign.io.kinds import OBSERVATION, is_of_many
from cadalign.io.observation import Observation
from cadalign.retrieval.options import RetrievalOptions
from cadalign.retrieval.query import ObservationRetrieval

if TYPE_CHECKING:
    from cadalign.retrieval.match import Match


@dataclass(frozen=True)
class _RetrievalOptions(RetrievalOptions):
    """Ranking of the models; the observation file supplies the standard deviation."""

    sigma: tyro.conf.Suppress[Sigma | None] = RetrievalOptions.sigma

    def __post_init__(self) -> None:
        """Check nothing: options are checked once the command runs, and refused in one line."""


@dataclass(frozen=True, kw_only=True)
class Retrieve(ManyCommand, ObservationRetrieval, CameraOptions):
    """Find the models of a library that explain an image's keypoints best.

    Each model is posed and stretched. The observation is a file as for `cadalign fit`; its
    keypoints need a semantic_id, or the name that the library has for it, and no xyz. A detector's
    file needs no --model. With --out, writes matches.json, an overlay of each
    match, its observation and fit, and index.html, which shows them side by side.
    Many observations are a run, as of `cadalign fit`: it writes results.parquet and results.csv
    with a row for each, and report.html.
    """

    out: Path | None = None
    """Folder for matches.json, the matches' overlays and index.html; by default none is
    written. For many observations the run's, by default beside them."""
    workers: int | None = None
    """Threads for one observation, -1 (the default) for one per core. Processes for many, 0 for
    none; by default -1, for few observations 0."""
    picture: bool = True
    """Write a page of many observations."""
    ranking: Annotated[
        _RetrievalOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_RetrievalOptions.__doc__)
    ] = _RetrievalOptions()

    def run(self) -> int:
        """Run the retrieval, or the retrievals; returns the exit code."""
        path = self.first()
        is_file = path.suffix.lower() == ".json" and os.path.isfile(path)
        data = read_json(path) if is_file else None
        with named_as_flags(self, self.ranking):
            how = ObservationRetrieval(
                library=self.library,
                shape=self.shape,
                sigma=self.sigma,
                ranking=RetrievalOptions(**vars(self.ranking)),
            )
            if len(self.observations) > 1 or is_of_many(path, data):
                return self._retrieve_many(how)
            self.refuse_of_many("workers")
            data = read_json(path, OBSERVATION) if data is None else data
            query = how.read(data, str(path), folder=path.parent, changes=self.changes)
            return self._retrieve(how.with_ids(query, str(path)), path, how)

    def _retrieve_many(self, how: ObservationRetrieval) -> int:
        """Retrieve the models of all observations; returns the exit code."""
        from cadalign.batch.retrievals import RetrieveRunOptions
        from cadalign.cli.runs import inputs_of, run_command

        options = RetrieveRunOptions(estimate=how, **inputs_of(self))
        return run_command(self, options, done="retrieved")

    def _retrieve(self, query: Observation, path: Path, how: ObservationRetrieval) -> int:
        """Retrieve the models of one observation, read of a path; returns the exit code."""
        from cadalign.retrieval.page import none_text, write_retrieval

        library, _ = how.opened()
        # The table needs no photo, which may have been moved.
        photo = None
        if self.out is not None and query.image is not None:
            photo = read_image(query.image, query.camera)
        with waiting("retrieving (the first time after an installation takes a minute)"):
            workers = -1 if self.workers is None else self.workers
            matches = how.retrieve(query, str(path), workers=workers)
        if self.json:
            print_json([match.to_dict() for match in matches])
        else:
            _print_table(matches)
            absent = none_text(matches)
            if absent is not None:
                say(absent)
        if self.out is not None:
            make_folder(self.out)
            with keeping([path, *query.files, self.library]):
                page = write_retrieval(
                    self.out,
                    matches,
                    query.camera,
                    query=query,
                    title=f"Models for {path.name}",
                    library=f"{self.library.name} ({len(library):,} models)",
                    image=photo,
                )
            say(f"Page: {page}")
        return 0


def _print_table(matches: Sequence[Match]) -> None:
    from cadalign.evaluation.summary import ConsoleTable
    from cadalign.retrieval.page import score_text

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
