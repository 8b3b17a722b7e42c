"""`cadalign retrieve`: which model of a library one image's keypoints show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.output import make_folder, new_console
from cadalign.cli.runs import print_json

if TYPE_CHECKING:
    from cadalign.fitting.options import Sigma
    from cadalign.io.observation import Observation
    from cadalign.retrieval import Match


@dataclass(frozen=True)
class Retrieve:
    """Find the models of a library that explain an image's keypoints best.

    Each model is posed and stretched. The observation is a file as for `cadalign fit`; its
    keypoints need a semantic_id and no xyz. With --out, writes matches.json, an overlay of each
    match, and index.html, which shows them side by side.
    """

    observation: Annotated[Path, tyro.conf.Positional]
    """JSON file with camera and keypoints, optionally image."""
    library: Path
    """File that `cadalign library build` wrote."""
    top: int = 10
    """How many matches to show."""
    out: Path | None = None
    """Folder to write to."""
    category: str | None = None
    """The only category to compare with; all by default."""
    sigma: float | None = None
    """Standard deviation of the keypoints in pixels; by default the file's, or 1."""
    shape_sigma: float = 0.0
    """How far a model's keypoints may lie off the object's, as a share of the object's extent; for
    libraries with similar models only, 0.03, say."""
    robust: bool = False
    """Some keypoints may be wrong (Cauchy loss)."""
    symmetries: bool = False
    """Left and right may be confused: try the labels mirrored, too."""
    mask: Path | None = None
    """Picture whose white pixels are the object's: ranks the matches anew by their silhouettes."""
    silhouette: bool = False
    """The same with what is cut out of the image, or its opacity."""
    max_stretch: float = 4.0
    """No model is stretched more than this, or less than one over it."""
    workers: int = -1
    """Threads; -1 for one for each core."""
    json: bool = False
    """Print the matches as JSON."""

    def run(self) -> int:
        """Run the retrieval; returns the exit code."""
        from cadalign.io.images import read_image
        from cadalign.retrieval import Library
        from cadalign.retrieval.page import write_retrieval
        from cadalign.retrieval.pictures import read_mask, read_opacity
        from cadalign.retrieval.query import read_query

        query = read_query(self.observation)
        assert query.semantic_ids is not None
        library = Library.open(self.library)
        camera = query.camera
        mask = None if self.mask is None else read_mask(self.mask, camera)
        image = read_opacity(query.image, camera) if self.silhouette else None
        # A table needs no photo, which may have moved.
        shown = None if self.out is None else query.image
        photo = None if shown is None else read_image(shown, camera)
        console = new_console()
        with console.status("retrieving (the first time after an installation takes a minute)"):
            matches = library.retrieve(
                query.points_2d,
                query.semantic_ids,
                camera,
                top=self.top,
                category=self.category,
                sigma=self._sigma(query),
                shape_sigma=self.shape_sigma,
                loss="cauchy" if self.robust else "linear",
                symmetries=self.symmetries,
                max_stretch=self.max_stretch,
                mask=mask,
                image=image,
                workers=self.workers,
            )
        if self.json:
            print_json([match.to_dict() for match in matches])
        else:
            _print_table(matches)
        if self.out is not None:
            make_folder(self.out)
            page = write_retrieval(
                self.out,
                matches,
                camera,
                title=f"Models for {self.observation.name}",
                library=f"{self.library.name} ({len(library):,} models)",
                image=photo,
            )
            console.print(f"Page: {page}", markup=False)
        return 0

    def _sigma(self, query: Observation) -> Sigma:
        """The keypoints' standard deviations: as given, the file's, or 1 px."""
        if self.sigma is not None:
            return self.sigma
        return 1.0 if query.sigma is None else query.sigma


def _print_table(matches: Sequence[Match]) -> None:
    from rich import box
    from rich.table import Table

    from cadalign.retrieval.page import score_text

    with_masks = any(match.silhouette_iou is not None for match in matches)
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("", justify="right", no_wrap=True)
    for name in ("category", "model"):
        table.add_column(name, no_wrap=True)
    for name in ("score", "log-lik.", "rms px", "kpts", "s_y", "s_z", *["IoU"][: int(with_masks)]):
        table.add_column(name, justify="right", no_wrap=True)
    for place, match in enumerate(matches, start=1):
        overlap = match.silhouette_iou
        table.add_row(
            str(place),
            match.category,
            match.model_id + (" (mirrored)" if match.mirrored else ""),
            score_text(match.score),
            f"{match.log_likelihood:.1f}",
            f"{match.rms:.2f}",
            f"{match.shared}/{match.shared + len(match.missing_ids)}",
            f"{match.alignment.scale[1]:.3f}",
            f"{match.alignment.scale[2]:.3f}",
            *(["-" if overlap is None else f"{overlap:.3f}"] if with_masks else []),
        )
    new_console(stderr=False).print(table)
