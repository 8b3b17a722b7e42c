"""A rendered model laid over a photo: its own shading or a tinted veil, and its feature lines."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError
from cadalign.render.drawing.canvas import CASING, Canvas, Color
from cadalign.render.drawing.color import ByteImage, composite
from cadalign.render.drawing.pictures import feature_lines
from cadalign.render.frame import Frame, Geometry

FloatImage = npt.NDArray[np.float32]

SHADED = "shaded"
TRANSLUCENT = "translucent"
LINES = "lines"
STYLES = (TRANSLUCENT, LINES, SHADED)
VEIL_OPACITY = 0.5

# How much of the veil's colour is the model's own, so that its parts can be told apart.
_OWN_SHARE = 0.45
_LINE_OPACITY = 0.9
_CASING_OPACITY = 0.45


def check_model_style(geometry: Geometry, image: ByteImage, style: str, opacity: float) -> None:
    """Refuse an unknown style, an opacity out of range, or a frame of another size."""
    if style not in STYLES:
        raise InputError(
            f"unknown style {style!r}", where="model_style", fix=f"known are {', '.join(STYLES)}"
        )
    if not 0 <= opacity <= 1:
        raise InputError(f"{opacity} is not from 0 to 1", where="model_opacity")
    if geometry.depth.shape != image.shape[:2]:
        rows, columns = geometry.depth.shape
        raise InputError(
            f"it is {columns} x {rows} px, the image {image.shape[1]} x {image.shape[0]}",
            where="est_frame",
            fix="render the model with the image's camera",
        )


def shade(image: ByteImage, geometry: Geometry, opacity: float) -> ByteImage:
    """Put a model over an image in its own colours, blended in linear light; (h, w, 3) uint8."""
    own, cover = _colors_of(geometry)
    front = np.dstack([own, 255 * opacity * cover]) + np.float32(0.5)
    return composite(front.astype(np.uint8), image)


def veil(image: ByteImage, geometry: Geometry, color: Color, opacity: float) -> ByteImage:
    """Let a model shine through in a colour; (h, w, 3) uint8."""
    own, cover = _colors_of(geometry)
    grey = own.mean(axis=2, keepdims=True) / 255
    # White in the light, the colour itself in the middle, dark in the shade.
    tinted = np.minimum(2 * grey, 1) * np.array(color, np.float32) + np.maximum(2 * grey - 1, 0) * (
        255 - np.array(color, np.float32)
    )
    front = _OWN_SHARE * own + (1 - _OWN_SHARE) * tinted
    share = opacity * cover[:, :, None]
    return np.asarray(image * (1 - share) + front * share + 0.5, dtype=np.uint8)


def _colors_of(geometry: Geometry) -> tuple[FloatImage, FloatImage]:
    """Colours (h, w, 3) from 0 to 255, and the share (h, w) of each pixel that is covered.

    A `Frame` has its own colours and shading, mere geometry shading alone.
    """
    if isinstance(geometry, Frame):
        cover: FloatImage = (geometry.color[:, :, 3] / 255).astype(np.float32)
        return geometry.color[:, :, :3].astype(np.float32), cover
    facing = np.float32(0.35) + np.float32(0.65) * np.abs(geometry.normal[:, :, 2])
    covered: FloatImage = geometry.mask.astype(np.float32)
    return np.repeat(255 * facing[:, :, None], 3, axis=2), covered


def draw_lines(canvas: Canvas, geometry: Geometry, color: Color) -> None:
    """Draw a model's outline and edges on a canvas, with a dark casing."""
    lines = feature_lines(geometry).astype(np.float32)
    rows, columns = canvas.image.shape[:2]
    thick = max(1, round(canvas.unit * geometry.depth.shape[0] / rows))
    if thick > 1:
        lines = np.asarray(cv2.dilate(lines, np.ones((thick, thick), np.uint8)), np.float32)
    wide = cv2.dilate(lines, np.ones((3, 3), np.uint8))
    for share, shade, opacity in (
        (wide, CASING, _CASING_OPACITY),
        (lines, color, _LINE_OPACITY),
    ):
        soft = cv2.resize(share, (columns, rows), interpolation=cv2.INTER_LINEAR)
        weight = opacity * soft[:, :, None]
        mixed = canvas.image * (1 - weight) + np.array(shade, np.float32) * weight
        canvas.image = np.asarray(mixed + 0.5, dtype=np.uint8)
