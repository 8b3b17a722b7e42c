"""Output folder of a retrieval: matches as JSON, observations and overlays."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from cadalign.errors import CadalignError
from cadalign.io.files import refuse_input, write_json
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render.canvas import ByteImage
from cadalign.render.layers import contact_sheet
from cadalign.render.overlay import draw_result, photo_of
from cadalign.retrieval.match import Match

logger = logging.getLogger("cadalign")


def write_retrieval(
    folder: Path, matches: Sequence[Match], query: Observation, *, image: ByteImage | None
) -> Path:
    """Write the matches of a query to a folder; returns the path of ``matches.png``.

    The files are ``matches.json``, an overlay of each match (``overlay_01.png``), all overlays in a
    grid (``matches.png``), and an observation of each match's model (``match_01.json``), for
    `cadalign fit`. Without a photo the overlays have a grey background.
    """
    photo = photo_of(image, query.camera)
    for rank in range(1, len(matches) + 1):
        for path in _files(folder, rank):
            refuse_input(path)
    write_json(folder / "matches.json", [match.to_dict() for match in matches])
    overlays = {}
    for rank, match in enumerate(matches, start=1):
        overlay, observation = _files(folder, rank)
        drawn = draw_match(photo, match)
        overlays[f"{rank}. {match.category} {match.model_id}: {score_text(match.score)}"] = drawn
        write_image(overlay, drawn)
        match.observation(query).save(observation)
    sheet = folder / "matches.png"
    write_image(sheet, contact_sheet(overlays))
    return sheet


def _files(folder: Path, rank: int) -> tuple[Path, Path]:
    """Paths of a match's overlay and observation; ranks count from 1."""
    return folder / f"overlay_{rank:02d}.png", folder / f"match_{rank:02d}.json"


def draw_match(image: ByteImage, match: Match) -> ByteImage:
    """Draw a match over its photo: box, keypoints and, with a readable mesh, the model."""
    mesh = None
    try:
        mesh = match.mesh()
    except CadalignError as error:
        logger.warning("the model is not drawn: %s", error)
    return draw_result(image, match.result, mesh=mesh)


def none_text(matches: Sequence[Match]) -> str | None:
    """Line of text with the probability that the object is none of the models."""
    probability = matches[0].none_probability if matches else None
    return None if probability is None else f"None of these: {score_text(probability)}"


def score_text(score: float) -> str:
    """Format a probability in percent."""
    return f"{100 * score:.1f} %" if score >= 0.0005 else "< 0.1 %"
