"""Cards of values in notebooks: a small picture beside a table, and axes in a photo's pixels."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH = 320  # of a picture [px]
_DPI = 100
_GREY = 0.9


def photo_axes(
    width: int, height: int, image: npt.ArrayLike | None = None, *, axes: Axes | None = None
) -> Axes:
    """Draw a photo (h, w[, 3]) of a camera with so many pixels, or grey where there is none.

    Returns axes in its pixels: the given ones, or those of a new figure.

    Raises
    ------
    InputError
        If the photo is not of the camera's size.
    """
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(figsize=(8, 8 * height / width))[1]
    pixels = np.full((1, 1, 3), _GREY) if image is None else np.asarray(image)
    if image is not None and pixels.shape[:2] != (height, width):
        raise InputError(
            f"shape {pixels.shape}, but the camera has {width} x {height} pixels",
            where="image",
            fix="give the photo of this camera",
        )
    axes.imshow(
        pixels,
        cmap="gray",
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        interpolation="antialiased",
    )
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_axis_off()
    return axes


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
