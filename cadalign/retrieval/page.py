"""Folder of a retrieval: the matches as JSON, an overlay of each, and a page of all."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from cadalign.errors import CadalignError
from cadalign.geometry.camera import Camera
from cadalign.io.files import made_folder, refuse_input, write_json, write_text
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render import Geometry, Scene, cast_geometry, draw_overlay
from cadalign.render.canvas import ByteImage
from cadalign.render.scene import LIGHT_GREY
from cadalign.retrieval.match import Match
from cadalign.web import asset, fill

logger = logging.getLogger("cadalign")


def write_retrieval(
    folder: Path,
    matches: Sequence[Match],
    camera: Camera,
    *,
    title: str,
    library: str,
    image: ByteImage | None,
    query: Observation | None = None,
) -> Path:
    """Write ``matches.json``, ``overlay_01.png`` and so on, and ``index.html``; returns the page.

    The library is described by text. Without a photo the overlays are drawn on grey. For a query,
    ``match_01.json`` and so on are the observation of each match's model, and
    ``match_01_fit/fit.json`` its result, which `cadalign export` takes.
    """
    if image is None:
        image = np.full((camera.height, camera.width, 3), LIGHT_GREY, dtype=np.uint8)
    for rank in range(1, len(matches) + 1):
        for path in _files(folder, rank):
            refuse_input(path)
    write_json(folder / "matches.json", [match.to_dict() for match in matches])
    for rank, match in enumerate(matches, start=1):
        overlay, observation, fit = _files(folder, rank)
        write_image(overlay, draw_match(image, camera, match))
        if query is not None:
            seen = match.observation(query)
            seen.save(observation)
            fitted = seen.to_dict(folder=made_folder(fit.parent))
            write_json(fit, match.result.to_dict() | {"observation": fitted})
    none = none_text(matches)
    html = fill(
        "retrieval.html",
        title=escape(title),
        style=asset("retrieval.css"),
        models="most likely model" if len(matches) == 1 else f"{len(matches)} most likely models",
        library=escape(library),
        none="" if none is None else f'<p class="lead"><strong>{escape(none)}</strong></p>',
        matches="".join(_card(rank, match) for rank, match in enumerate(matches, start=1)),
    )
    page = folder / "index.html"
    write_text(page, html)
    return page


def _files(folder: Path, rank: int) -> tuple[Path, Path, Path]:
    """A match's overlay, observation and fit; ranks count from 1."""
    names = (f"overlay_{rank:02d}.png", f"match_{rank:02d}.json", f"match_{rank:02d}_fit/fit.json")
    overlay, observation, fit = (folder / name for name in names)
    return overlay, observation, fit


def draw_match(image: ByteImage, camera: Camera, match: Match) -> ByteImage:
    """Draw a match over its photo: box, keypoints and, where there is a mesh, the model."""
    (seen,) = match.result.views
    return draw_overlay(
        image,
        camera,
        est_box=match.box,
        est_frame=_cast(match, camera),  # without a mesh, keypoints and box are drawn
        observed=seen.points_2d,
        reprojected=seen.points_2d + seen.residuals,
    )


def none_text(matches: Sequence[Match]) -> str | None:
    """Sentence of a table or page on the probability that the object is none of the models."""
    probability = matches[0].none_probability if matches else None
    return None if probability is None else f"None of these: {score_text(probability)}"


def _card(rank: int, match: Match) -> str:
    y, z = match.stretch_texts
    values = {
        "stretch": f"y {y}, z {z}",
        "residuals": f"{match.rms:.2f} px",
        "shared keypoints": match.shared_text,
        "log-likelihood": f"{match.log_likelihood:.1f}",
    }
    rows = [fill("retrieval_value.html", label=key, value=value) for key, value in values.items()]
    return fill(
        "retrieval_match.html",
        rank=rank,
        category=escape(match.category),
        model_id=escape(match.model_id),
        picture=_files(Path(), rank)[0].name,
        score=escape(score_text(match.score)),
        percent=f"{100 * match.score:.1f}",
        values="".join(rows),
    )


def score_text(score: float) -> str:
    """Format a probability in percent."""
    return f"{100 * score:.1f} %" if score >= 0.0005 else "< 0.1 %"


def _cast(match: Match, camera: Camera) -> Geometry | None:
    """Cast rays at a match's mesh; None if there is none or, with a warning, it is unreadable."""
    try:
        mesh = match.mesh()
        return None if mesh is None else cast_geometry(Scene(mesh), camera, match.alignment)
    except CadalignError as error:
        logger.warning("no silhouette: %s", error)
        return None
