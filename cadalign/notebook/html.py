"""A card in a notebook: title, small picture and table as HTML."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH = 320  # of a picture [px]
_DPI = 100


def card(
    title: str, rows: Sequence[tuple[str, str]], *, picture: bytes | None = None, note: str = ""
) -> str:
    """HTML of a value: a title, a PNG picture, and a table of names and texts.

    Examples
    --------
    >>> card("Camera", [("size", "640 x 480 px")]).count("<tr>")
    1
    """
    cells = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th>"
        f"<td style='text-align:left'>{escape(text)}</td></tr>"
        for name, text in rows
    )
    image = ""
    if picture is not None:
        data = base64.b64encode(picture).decode()
        image = f"<img alt='' width='{_WIDTH}' src='data:image/png;base64,{data}'>"
    text = f"<p style='margin:.3em 0'>{escape(note)}</p>" if note else ""
    return (
        f"<div><b>{escape(title)}</b>"
        "<div style='display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start'>"
        f"{image}<table>{cells}</table></div>{text}</div>"
    )


def draw_picture(draw: Callable[[Axes], object], *, aspect: float = 0.75) -> bytes:
    """PNG of what ``draw`` draws on axes that fill the picture; ``aspect`` is height by width."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH / _DPI, _WIDTH / _DPI * aspect))
    FigureCanvasAgg(figure)
    draw(figure.add_axes((0.0, 0.0, 1.0, 1.0)))
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=2 * _DPI)
    return data.getvalue()
