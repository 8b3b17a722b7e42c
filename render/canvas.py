"""Antialiased lines, markers and text with a dark casing; sRGB and linear light."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.pixels import rescaled_pixels

Color = tuple[int, int, int]

CASING: Color = (18, 20, 24)
# OpenCV takes fixed-point coordinates, with this many fractional bits.
_SHIFT = 4
# Larger coordinates [px] would overflow in OpenCV.
_FARTHEST = 1e6
_PLATE_OPACITY = 0.62
_SMALL_SIDE = 1000
# Widths of casings, in units; markers are small and need a wider one.
_LINE_CASING, _MARKER_CASING = 0.6, 0.75

_Strokes = tuple[tuple[Color, int], ...]


LegendEntry = tuple[str, Color, str]
"""Entry of the legend: text, colour, and marker, which is "line", "ring" or "cross"."""


class Canvas:
    """An image to draw on. A small one is enlarged to twice its size, for finer lines.

    The image (h, w, 3) uint8 is copied. All methods take pixels of the original image.

    Attributes
    ----------
    image : (h, w, 3) uint8
        The enlarged image.
    unit : float
        Width of a thin line [px], in proportion to the image.
    """

    def __init__(self, image: ByteImage) -> None:
        rows, columns = image.shape[:2]
        self._zoom = 2 if min(rows, columns) < _SMALL_SIDE else 1
        size = (columns * self._zoom, rows * self._zoom)
        enlarged = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_NEAREST)
        self.image: ByteImage = np.asarray(enlarged, dtype=np.uint8)
        self.unit = max(0.5, min(rows, columns) / 480)

    def finish(self) -> ByteImage:
        """Return the image at its original size; pixels without drawing are unchanged."""
        if self._zoom == 1:
            return self.image
        rows, columns = self.image.shape[:2]
        size = (columns // self._zoom, rows // self._zoom)
        return np.asarray(cv2.resize(self.image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _strokes(self, color: Color, *, width: float, casing: float) -> _Strokes:
        """Colour and thickness [canvas px] of a line's casing, then of the line itself."""
        scale = self.unit * self._zoom
        inner, border = (max(1, round(value * scale)) for value in (width, casing))
        return (CASING, inner + 2 * border), (color, inner)

    def fade(self, before: ByteImage, *, opacity: float) -> None:
        """Give an opacity to everything drawn since the copy ``before`` of the image."""
        self.image = np.asarray(
            cv2.addWeighted(self.image, opacity, before, 1 - opacity, 0), dtype=np.uint8
        )

    def line(self, points: FloatArray, color: Color, *, width: float, dashed: bool = False) -> None:
        """Draw a line through pixels (n, 2); ``width`` is in units."""
        parts = _dashes(points, 7 * self.unit, 5 * self.unit) if dashed else points[None]
        self._lines(parts, self._strokes(color, width=width, casing=_LINE_CASING))

    def hairline(self, points: FloatArray, color: Color) -> None:
        """Draw a thin line without a casing through pixels (n, 2)."""
        self._lines(points[None], self._strokes(color, width=1.0, casing=0.0)[1:])

    def _lines(self, parts: FloatArray, strokes: _Strokes) -> None:
        """Draw lines through pixels (m, n, 2), all casings first."""
        for shade, thickness in strokes:
            whole = list(self._whole(parts))
            cv2.polylines(self.image, whole, False, shade, thickness, cv2.LINE_AA, _SHIFT)

    def dot(self, point: FloatArray, color: Color, *, radius: float) -> None:
        """Draw a disc without a casing."""
        self._circle(point, color, radius, -1)

    def ring(self, point: FloatArray, color: Color, *, radius: float) -> None:
        """Draw a circle."""
        for shade, thickness in self._strokes(color, width=1.5, casing=_MARKER_CASING):
            self._circle(point, shade, radius, thickness)

    def _circle(self, point: FloatArray, color: Color, radius: float, thickness: int) -> None:
        x, y = (int(value) for value in self._whole(point))
        reach = int(radius * self.unit * self._zoom * (1 << _SHIFT))
        cv2.circle(self.image, (x, y), reach, color, thickness, cv2.LINE_AA, _SHIFT)

    def cross(self, point: FloatArray, color: Color, *, radius: float) -> None:
        """Draw an upright cross."""
        arms = point + radius * self.unit * np.array([[[-1, 0], [1, 0]], [[0, -1], [0, 1]]])
        self._lines(arms, self._strokes(color, width=1.5, casing=_MARKER_CASING))

    def arrow(self, start: FloatArray, end: FloatArray, color: Color, *, width: float) -> None:
        """Draw an arrow between two pixels (2,)."""
        along = end - start
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            return
        along = along / length
        (_, outer), (_, inner) = self._strokes(color, width=width, casing=_LINE_CASING)
        half, head = inner / 2 / self._zoom, min(4.5 * width * self.unit, length)
        # One side of the outline from the tip, along and across the arrow; then the other side.
        side = np.array([[0, 0], [-head, 0.42 * head], [-head, half], [-length, half]])
        outline = np.concatenate([side, side[:0:-1] * (1, -1)])
        whole = self._whole(end + outline @ [along, [-along[1], along[0]]])
        cv2.polylines(self.image, [whole], True, CASING, outer - inner, cv2.LINE_AA, _SHIFT)
        cv2.fillPoly(self.image, [whole], color, cv2.LINE_AA, _SHIFT)

    def label(self, text: str, middle: FloatArray, color: Color) -> None:
        """Write a short text centred at a pixel (2,)."""
        rows, columns = self.image.shape[:2]
        x, y = rescaled_pixels(middle, self._zoom)
        if not (0 <= x < columns and 0 <= y < rows):
            return
        scale = self.unit * self._zoom
        picture = Image.fromarray(self.image)
        ImageDraw.Draw(picture).text(
            (float(x), float(y)),
            text,
            fill=color,
            font=ImageFont.load_default(size=15 * scale),
            anchor="mm",
            stroke_width=max(1, round(scale)),
            stroke_fill=CASING,
        )
        self.image = np.array(picture)

    def legend(self, entries: list[LegendEntry], *, keep_clear: FloatArray) -> None:
        """Draw a legend in the corner where it covers the fewest ``keep_clear`` pixels (n, 2)."""
        size = round(12.5 * self.unit * self._zoom)
        font = ImageFont.load_default(size=size)
        pad, swatch, pitch = 0.7 * size, 1.9 * size, 1.45 * size
        width = round(3 * pad + swatch + max(font.getlength(text) for text, _, _ in entries))
        height = round(2 * pad + pitch * len(entries) - (pitch - size))
        rows, columns = self.image.shape[:2]
        if width + size > columns or height + size > rows:
            return
        clear = rescaled_pixels(keep_clear, self._zoom)
        left, top = self._emptiest_corner(width, height, round(0.7 * size), clear)
        plate = Image.new("L", (width, height), 0)
        ImageDraw.Draw(plate).rounded_rectangle(
            (0, 0, width - 1, height - 1), radius=0.4 * size, fill=round(255 * _PLATE_OPACITY)
        )
        picture = Image.fromarray(self.image)
        picture.paste(CASING, (left, top), plate)
        pen = ImageDraw.Draw(picture)
        middles = [top + pad + size / 2 + pitch * number for number in range(len(entries))]
        for (text, _, _), y in zip(entries, middles, strict=True):
            at = (left + 2 * pad + swatch, y)
            pen.text(at, text, fill=(245,) * 3, font=font, anchor="lm")
        self.image = np.array(picture)
        for (_, color, marker), y in zip(entries, middles, strict=True):
            places = np.array([[0.0, y], [swatch / 2, y], [swatch, y]]) + [left + pad, 0.0]
            begin, middle, end = rescaled_pixels(places, 1 / self._zoom)
            if marker == "ring":
                self.ring(middle, color, radius=4.5)
            elif marker == "cross":
                self.cross(middle, color, radius=4)
            else:
                self.line(np.array([begin, end]), color, width=2.5)

    def _emptiest_corner(
        self, width: int, height: int, gap: int, keep_clear: FloatArray
    ) -> tuple[int, int]:
        """Left and top of a plate in the corner where it covers the fewest pixels."""
        rows, columns = self.image.shape[:2]
        lefts, tops = (gap, columns - width - gap), (gap, rows - height - gap)
        corners = np.array([[(left, top)] for top in tops for left in lefts])
        inside = (keep_clear >= corners) & (keep_clear <= corners + (width, height))
        ((left, top),) = corners[inside.all(axis=2).sum(axis=1).argmin()].tolist()
        return left, top

    def _whole(self, points: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
        """Convert pixels to OpenCV's fixed-point coordinates on the canvas."""
        held = np.clip(rescaled_pixels(points, self._zoom), -_FARTHEST, _FARTHEST)
        return np.asarray(np.rint(held * (1 << _SHIFT)), dtype=np.int32)


def _dashes(points: FloatArray, dash: float, gap: float) -> FloatArray:
    """Cut a line (n, 2) into straight dashes [px], (m, 2, 2), the first and last of full length."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(steps)])
    count = min(max(1, round((reached[-1] + gap) / (dash + gap))), 1000)
    pitch = (reached[-1] + gap) / count
    begins = np.arange(count) * pitch
    ends = np.maximum(begins + (pitch - gap), begins)
    at = np.stack([begins, ends], axis=1)
    return np.stack([np.interp(at, reached, points[:, axis]) for axis in (0, 1)], axis=2)


LinearArray = npt.NDArray[np.float32]
ByteImage = npt.NDArray[np.uint8]


def linear_from_srgb(encoded: npt.NDArray[Any]) -> LinearArray:
    """Decode sRGB values (0 to 1, any shape) to linear light; trimesh's is slow to import."""
    high = ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, encoded / 12.92, high).astype(np.float32)


_DECODED = linear_from_srgb(np.arange(256) / 255)
# sRGB bytes by the square root of linear light, which resolves dark values about as sRGB does.
_STEPS = 1 << 14
_LIMITS = linear_from_srgb((np.arange(255) + 0.5) / 255)
_ENCODED = np.searchsorted(_LIMITS, np.linspace(0, 1, _STEPS + 1) ** 2).astype(np.uint8)


def linear_from_bytes(image: ByteImage) -> LinearArray:
    """Decode sRGB bytes (any shape) to linear light; float32."""
    return np.asarray(_DECODED[image])


def bytes_from_linear(linear: LinearArray) -> ByteImage:
    """Encode linear light (any shape) to sRGB bytes."""
    place = np.sqrt(np.clip(linear, 0, 1)) * np.float32(_STEPS) + np.float32(0.5)
    return np.asarray(_ENCODED[place.astype(np.int32)])


def composite(color: ByteImage, background: npt.ArrayLike) -> ByteImage:
    """Composite an image with opacity (h, w, 4) over a background; see `Frame.composite`."""
    behind = np.asarray(background)
    shape = (*color.shape[:2], 3)
    if behind.shape not in ((3,), shape):
        raise InputError(f"shape {behind.shape} is neither (3,) nor {shape}", where="background")
    if behind.dtype.kind not in "ui" or behind.min(initial=0) < 0 or behind.max(initial=0) > 255:
        raise InputError("values must be integers from 0 to 255", where="background")
    result: ByteImage = np.empty(shape, dtype=np.uint8)
    result[:] = behind
    opacity = color[:, :, 3]
    np.copyto(result, color[:, :, :3], where=(opacity == 255)[:, :, None])
    mixed = (opacity > 0) & (opacity < 255)
    share = opacity[mixed, None] / np.float32(255)
    light = linear_from_bytes(color[mixed, :3]) * share
    light += linear_from_bytes(result[mixed]) * (1 - share)
    result[mixed] = bytes_from_linear(np.asarray(light, dtype=np.float32))
    return result
