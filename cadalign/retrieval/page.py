"""Folder of a retrieval: the matches as JSON, an overlay of each, and a page of all."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from cadalign.geometry.camera import Camera
from cadalign.io.files import made_folder, write_json, write_text, writing
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render import draw_overlay
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.scene import LIGHT_GREY
from cadalign.retrieval.by_mask import cast_match
from cadalign.retrieval.match import Match
from cadalign.web import asset, fill


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
    with writing(folder):  # overlays of an earlier retrieval, but no files with similar names
        for path in folder.glob("overlay_*.png"):
            number = path.stem.removeprefix("overlay_")
            if number.isdecimal() and path.name == overlay_name(int(number)):
                path.unlink()
    for rank, match in enumerate(matches, start=1):
        write_image(folder / overlay_name(rank), draw_match(image, camera, match))
        if query is not None:
            match.observation(query).save(folder / f"match_{rank:02d}.json")
            match.result.save(made_folder(folder / f"match_{rank:02d}_fit") / "fit.json")
    write_json(folder / "matches.json", [match.to_dict() for match in matches])
    none = none_text(matches)
    html = fill(
        "retrieval.html",
        title=escape(title),
        style=asset("retrieval.css"),
        count=len(matches),
        library=escape(library),
        none="" if none is None else f'<p class="lead"><strong>{escape(none)}</strong></p>',
        matches="".join(_card(rank, match) for rank, match in enumerate(matches, start=1)),
    )
    page = folder / "index.html"
    write_text(page, html)
    return page


def overlay_name(rank: int) -> str:
    """File name of a match's overlay; ranks count from 1."""
    return f"overlay_{rank:02d}.png"


def draw_match(image: ByteImage, camera: Camera, match: Match) -> ByteImage:
    """Draw a match over its photo: box, keypoints and, where there is a mesh, the model."""
    return draw_overlay(
        image,
        camera,
        est_box=match.box,
        est_frame=cast_match(match, camera),  # without a mesh, keypoints and box are drawn
        observed=match.points_2d,
        reprojected=match.points_2d + match.residuals,
    )


def none_text(matches: Sequence[Match]) -> str | None:
    """Sentence of a table or page on the probability that the object is none of the models."""
    probability = matches[0].none_probability if matches else None
    return None if probability is None else f"None of these: {score_text(probability)}"


def _card(rank: int, match: Match) -> str:
    scale = match.alignment.scale
    values = {
        "stretch": f"y {scale[1]:.2f}, z {scale[2]:.2f}",
        "residuals": f"{match.rms:.2f} px",
        "shared keypoints": f"{match.shared} of {match.shared + len(match.missing_ids)}",
        "log-likelihood": f"{match.log_likelihood:.1f}",
    }
    if match.silhouette_iou is not None:
        values["silhouette IoU"] = f"{match.silhouette_iou:.3f}"
    if match.mirrored:
        values["labels"] = "left and right exchanged"
    rows = [fill("retrieval_value.html", label=key, value=value) for key, value in values.items()]
    return fill(
        "retrieval_match.html",
        rank=rank,
        category=escape(match.category),
        model_id=escape(match.model_id),
        picture=overlay_name(rank),
        score=escape(score_text(match.score)),
        percent=f"{100 * match.score:.1f}",
        values="".join(rows),
    )


def score_text(score: float) -> str:
    """Format a probability in percent."""
    return f"{100 * score:.1f} %" if score >= 0.0005 else "< 0.1 %"
