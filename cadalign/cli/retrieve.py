"""`cadalign retrieve`: rank the models of a library by an image's keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.cli.options import (
    ObservationCommand,
    OptionError,
    make_folder,
    named_as_flags,
    new_console,
)
from cadalign.cli.runs import print_json, print_table
from cadalign.errors import InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.options import Sigma
from cadalign.io.images import read_image
from cadalign.retrieval import Match
from cadalign.retrieval.options import RetrievalOptions
from cadalign.shapes.model import ShapeModel


@dataclass(frozen=True)
class _RetrievalOptions(RetrievalOptions):
    """Ranking of the models; the observation file supplies the standard deviation."""

    sigma: tyro.conf.Suppress[Sigma | None] = RetrievalOptions.sigma
    method: str = RetrievalOptions.method
    """Solver: optimal (maximum likelihood, searched globally) or epnp (OpenCV's, without
    stretch)."""

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class Retrieve(ObservationCommand):
    """Find the models of a library that explain an image's keypoints best.

    Each model is posed and stretched. The observation is a file as for `cadalign fit`; its
    keypoints need a semantic_id and no xyz. With --out, writes matches.json, an overlay of each
    match, and index.html, which shows them side by side.
    """

    observation: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OBSERVATION")]
    """JSON file with camera and keypoints, optionally image."""
    library: Path
    """File that `cadalign library build` wrote."""
    shape: tuple[Path, ...] = ()
    """Files that `cadalign shape learn` wrote, one for each category: ranks their models by the
    shape estimated from the keypoints, for objects that are not in the library. An unknown focal
    length is estimated with it, with the photo's EXIF data as a prior."""
    out: Path | None = None
    """Folder for matches.json, the matches' overlays and index.html; by default none is
    written."""
    mask: Path | None = None
    """Image of the object's pixels in white: ranks the matches again by their silhouettes."""
    silhouette: bool = False
    """The same with the photo's opacity, or with what is segmented around the keypoints."""
    workers: int = -1
    """Number of threads; -1 for one per core."""
    ranking: Annotated[
        _RetrievalOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_RetrievalOptions.__doc__)
    ] = _RetrievalOptions()

    def run(self) -> int:
        """Run the retrieval; returns the exit code."""
        from cadalign.retrieval import Library
        from cadalign.retrieval.page import none_text, write_retrieval
        from cadalign.retrieval.query import read_mask, read_opacity, read_query

        query = read_query(self.observation)
        assert query.semantic_ids is not None
        library = Library.open(self.library)
        shape = _open_shapes(self.shape)
        camera = query.camera
        prior = None
        if not camera.focal_known:
            if shape is None:
                raise InputError(
                    "the focal length is unknown, without which no model's pose is searched",
                    where=f"{self.observation}: camera",
                    fix="rank by --shape, which estimates it, or give a calibrated camera",
                )
            if query.image is not None:
                prior = FocalPrior.from_exif(query.image)
        mask = None if self.mask is None else read_mask(self.mask, camera)
        image = read_opacity(query.image, camera) if self.silhouette else None
        # The table needs no photo, which may have been moved.
        photo = None
        if self.out is not None and query.image is not None:
            photo = read_image(query.image, camera)
        console = new_console()
        status = console.status("retrieving (the first time after an installation takes a minute)")
        with status, named_as_flags(self, self.ranking):
            matches = library.retrieve(
                query.points_2d,
                query.semantic_ids,
                camera,
                **vars(replace(self.ranking, sigma=self.sigma_of(query))),
                shape=shape,
                focal_prior=prior,
                mask=mask,
                image=image,
                workers=self.workers,
            )
        found = matches[0].camera if matches else None
        if not camera.focal_known and found is not None:
            camera = found
            console.print(f"Focal length: estimated as {camera.fx:.4g} px", markup=False)
        if self.json:
            print_json([match.to_dict() for match in matches])
        else:
            _print_table(matches)
            absent = none_text(matches)
            if absent is not None:
                console.print(absent, markup=False, highlight=False)
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


def _open_shapes(paths: Sequence[Path]) -> ShapeModel | dict[str, ShapeModel] | None:
    """The shape models of files: one, or several by category; None of no file."""
    models = [ShapeModel.open(path) for path in paths]
    if len(models) < 2:
        return models[0] if models else None
    by_category = {model.category: model for model in models}
    if len(by_category) < len(models):
        names = [model.category for model in models]
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two files of the category {twice!r}", where="--shape")
    return by_category


def _print_table(matches: Sequence[Match]) -> None:
    from cadalign.evaluation.summary import ConsoleTable
    from cadalign.retrieval.page import score_text

    labels = ("", "category", "model")
    heads: tuple[str, ...] = ("score", "log-lik.", "rms px", "kpts", "s_y", "s_z")
    rows: list[tuple[str, ...]] = [
        (
            str(rank).rjust(len(str(len(matches)))),
            match.category,
            match.model_id + (" (mirrored)" if match.mirrored else ""),
            score_text(match.score),
            f"{match.log_likelihood:.1f}",
            f"{match.rms:.2f}",
            f"{match.shared}/{match.shared + len(match.missing_ids)}",
            f"{match.alignment.scale[1]:.3f}",
            f"{match.alignment.scale[2]:.3f}",
        )
        for rank, match in enumerate(matches, start=1)
    ]
    overlaps = [match.silhouette_iou for match in matches]
    if any(overlap is not None for overlap in overlaps):
        heads += ("IoU",)
        shown = ["-" if overlap is None else f"{overlap:.3f}" for overlap in overlaps]
        rows = [(*row, overlap) for row, overlap in zip(rows, shown, strict=True)]
    print_table(ConsoleTable("", labels, heads, rows, "", narrow=True, grouped=False))
