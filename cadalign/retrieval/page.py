"""A retrieval's folder: the matches as JSON, an overlay of each, and a page with them in a row."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.geometry.camera import Camera
from cadalign.io.files import write_json, write_text, writing
from cadalign.io.images import write_image
from cadalign.render import Geometry, Scene, cast_geometry, draw_overlay
from cadalign.render.drawing.color import ByteImage
from cadalign.render.frame import LIGHT_GREY
from cadalign.retrieval.match import Match
from cadalign.web import asset

_STYLE = """
.retrieval { max-width: 90rem; margin: 0 auto; padding: 1.5rem 1rem 3rem; }
.retrieval h1 { font-size: 1.5rem; line-height: 1.25; margin: 0 0 .5rem; }
.retrieval .lead { color: var(--soft); max-width: 60rem; margin: 0 0 1.5rem; }
.retrieval h1, .retrieval .lead { overflow-wrap: anywhere; }
.retrieved-list { display: grid; gap: 1rem; margin: 0; padding: 0; list-style: none;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 19rem), 1fr)); }
.retrieved { background: var(--card); border: 1px solid var(--line); border-radius: .6rem;
  overflow: hidden; display: flex; flex-direction: column; }
.retrieved.first { border-color: var(--accent); box-shadow: 0 0 0 1px var(--accent); }
.retrieved img { display: block; width: 100%; height: auto; }
.retrieved .text { padding: .75rem .9rem .9rem; }
.retrieved h2 { font-size: 1rem; margin: 0; display: flex; justify-content: space-between; }
.retrieved code { color: var(--soft); font-size: .78rem; overflow-wrap: anywhere; }
.retrieved-score { height: .35rem; margin: .5rem 0 .6rem; background: var(--line); }
.retrieved-score i { display: block; height: 100%; background: var(--accent); }
.retrieved-score, .retrieved-score i { border-radius: .2rem; }
.retrieved dl { display: grid; grid-template-columns: auto 1fr; gap: .1rem .8rem; margin: 0;
  font-size: .85rem; }
.retrieved dt { color: var(--soft); }
.retrieved dd { margin: 0; text-align: right; font-variant-numeric: tabular-nums; }
"""
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main class="retrieval">
<h1>{title}</h1>
<p class="lead">{text}</p>
<ol class="retrieved-list">
{matches}
</ol>
</main>
</body>
</html>
"""


def write_retrieval(
    folder: Path,
    matches: Sequence[Match],
    camera: Camera,
    *,
    title: str,
    library: str,
    image: ByteImage | None = None,
) -> Path:
    """Write ``matches.json``, ``overlay_01.png`` and so on, and ``index.html``; returns the page.

    Parameters
    ----------
    folder : Path
        An existing folder.
    matches : sequence of Match
        The best first.
    camera : Camera
    title : str
        What was asked for.
    library : str
        What was looked through, in words.
    image : (h, w, 3) uint8, optional
        The photo; without it the overlays are drawn on grey.

    Raises
    ------
    DataError
        If a file cannot be written.
    """
    photo = image
    if photo is None:
        photo = np.full((camera.height, camera.width, 3), LIGHT_GREY, dtype=np.uint8)
    _remove_overlays(folder)
    for place, match in enumerate(matches, start=1):
        write_image(folder / overlay_name(place), draw_match(photo, camera, match))
    write_json(folder / "matches.json", [match.to_dict() for match in matches])
    text = (
        f"The {len(matches)} most likely models of {library}, each posed and stretched along y and "
        "z to explain the keypoints. The score is the probability of the model if it is one of the "
        "library's."
    )
    page = folder / "index.html"
    write_text(
        page,
        _PAGE.format(
            title=escape(title),
            style=asset("report.css") + _STYLE,
            text=escape(text),
            matches="\n".join(_card(place, match) for place, match in enumerate(matches, start=1)),
        ),
    )
    return page


def overlay_name(place: int) -> str:
    """The file name of a match's overlay, the first being 1."""
    return f"overlay_{place:02d}.png"


def _remove_overlays(folder: Path) -> None:
    """Remove what an earlier retrieval drew, and nothing else of that name's kind."""
    with writing(folder):
        for path in folder.glob("overlay_*.png"):
            place = path.stem.removeprefix("overlay_")
            if place.isdecimal() and path.name == overlay_name(int(place)):
                path.unlink()


def draw_match(image: ByteImage, camera: Camera, match: Match) -> ByteImage:
    """Draw a match over its photo: box, keypoints and, where there is a mesh, the model."""
    return draw_overlay(
        image,
        camera,
        est_box=match.box,
        est_frame=_model_in(camera, match),
        observed=match.points_2d,
        reprojected=match.points_2d + match.residuals,
    )


def _model_in(camera: Camera, match: Match) -> Geometry | None:
    from cadalign.datasets import load_mesh

    if match.mesh_path is None:
        return None
    try:
        return cast_geometry(Scene(load_mesh(match.mesh_path)), camera, match.alignment)
    except CadalignError:  # the keypoints and the box are there to see all the same
        return None


def _card(place: int, match: Match) -> str:
    scale: FloatArray = match.alignment.scale
    name = escape(f"{match.category} {match.model_id}", quote=True)
    source = overlay_name(place)
    rows = [
        ("stretch", f"y {scale[1]:.2f}, z {scale[2]:.2f}"),
        ("residuals", f"{match.rms:.2f} px"),
        ("shared keypoints", f"{match.shared} of {match.shared + len(match.missing_ids)}"),
        ("log-likelihood", f"{match.log_likelihood:.1f}"),
    ]
    if match.silhouette_iou is not None:
        rows.append(("silhouette IoU", f"{match.silhouette_iou:.3f}"))
    if match.mirrored:
        rows.append(("labels", "left and right exchanged"))
    numbers = "".join(f"<dt>{label}</dt><dd>{escape(value)}</dd>" for label, value in rows)
    return (
        f'<li class="retrieved{" first" if place == 1 else ""}">'
        f'<a href="{source}"><img src="{source}" alt="{name}, aligned" loading="lazy"></a>'
        f'<div class="text"><h2><span>{place}. {escape(match.category)}</span>'
        f"<span>{score_text(match.score)}</span></h2><code>{escape(match.model_id)}</code>"
        f'<div class="retrieved-score"><i style="width:{100 * match.score:.1f}%"></i></div>'
        f"<dl>{numbers}</dl></div></li>"
    )


def score_text(score: float) -> str:
    """A probability as text, in percent.

    Examples
    --------
    >>> score_text(0.123), score_text(1e-9)
    ('12.3 %', '< 0.1 %')
    """
    return f"{100 * score:.1f} %" if score >= 0.0005 else "< 0.1 %"
