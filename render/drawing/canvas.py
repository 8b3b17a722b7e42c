"""Lines, markers and text on an image: antialiased, with a dark casing that sets them off."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.pixels import rescaled_pixels

Color = tuple[int, int, int]

CASING: Color = (18, 20, 24)
# OpenCV takes whole numbers; this many bits of them are the fraction of a pixel.
_SHIFT = 4
# Farther off than this [px] OpenCV's whole numbers would overflow.
_FARTHEST = 1e6
_PLATE_OPACITY = 0.62
_SMALL_SIDE = 1000
# Widths of dark borders, in units; markers are small and need more to stand out.
_LINE_CASING, _MARKER_CASING = 0.6, 0.75

_Strokes = tuple[tuple[Color, int], tuple[Color, int]]


LegendEntry = tuple[str, Color, str]
"""A line of the legend: text, colour, and its marker, a "line", "ring" or "cross"."""


class Canvas:
    """An image that is drawn on, a small one at twice its size, for finer lines.

    The image (h, w, 3) uint8 is copied. All methods take pixels of the canvas: see `place`.

    Attributes
    ----------
    image : (h, w, 3) uint8
        The canvas.
    unit : float
        The width of a thin line [canvas px], which grows with the image.
    """

    def __init__(self, image: ByteImage) -> None:
        rows, columns = image.shape[:2]
        self._zoom = 2 if min(rows, columns) < _SMALL_SIDE else 1
        size = (columns * self._zoom, rows * self._zoom)
        enlarged = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_NEAREST)
        self.image: ByteImage = np.asarray(enlarged, dtype=np.uint8)
        self.unit = float(self._zoom * max(0.5, min(rows, columns) / 480))

    def place(self, points: FloatArray) -> FloatArray:
        """Take pixels (n, 2) of the image to those of the canvas."""
        return rescaled_pixels(points, self._zoom)

    def finished(self) -> ByteImage:
        """The drawn image at its own size; where nothing was drawn it is what it was."""
        if self._zoom == 1:
            return self.image
        rows, columns = self.image.shape[:2]
        size = (columns // self._zoom, rows // self._zoom)
        return np.asarray(cv2.resize(self.image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _strokes(self, color: Color, *, width: float, casing: float) -> _Strokes:
        """Colour and thickness [canvas px] of a line's dark border, then of the line itself."""
        inner, border = (max(1, round(value * self.unit)) for value in (width, casing))
        return (CASING, inner + 2 * border), (color, inner)

    def blend_from(self, before: ByteImage, *, opacity: float) -> None:
        """Let what was drawn since ``before`` was copied show through to it."""
        self.image = np.asarray(
            cv2.addWeighted(self.image, opacity, before, 1 - opacity, 0), dtype=np.uint8
        )

    def line(self, points: FloatArray, color: Color, *, width: float, dashed: bool = False) -> None:
        """Draw a line through (n, 2) pixels; its width is in units."""
        parts = _dashes(points, 7 * self.unit, 5 * self.unit) if dashed else [points]
        fixed = np.split(
            _fixed_point(np.concatenate(parts)), np.cumsum([len(part) for part in parts[:-1]])
        )
        for shade, thickness in self._strokes(color, width=width, casing=_LINE_CASING):
            cv2.polylines(self.image, fixed, False, shade, thickness, cv2.LINE_AA, _SHIFT)

    def dot(self, point: FloatArray, color: Color, *, radius: float) -> None:
        """Draw a disc without casing."""
        self._circle(point, color, radius, -1)

    def ring(self, point: FloatArray, color: Color, *, radius: float) -> None:
        """Draw a circle."""
        for shade, thickness in self._strokes(color, width=1.5, casing=_MARKER_CASING):
            self._circle(point, shade, radius, thickness)

    def _circle(self, point: FloatArray, color: Color, radius: float, thickness: int) -> None:
        x, y = (int(value) for value in _fixed_point(point))
        fixed = int(radius * self.unit * (1 << _SHIFT))
        cv2.circle(self.image, (x, y), fixed, color, thickness, cv2.LINE_AA, _SHIFT)

    def cross(self, point: FloatArray, color: Color, *, radius: float) -> None:
        """Draw an upright cross."""
        reach = radius * self.unit
        arms = [point + np.array(arm) * reach for arm in ([[-1, 0], [1, 0]], [[0, -1], [0, 1]])]
        fixed = [_fixed_point(arm) for arm in arms]
        for shade, thickness in self._strokes(color, width=1.5, casing=_MARKER_CASING):
            cv2.polylines(self.image, fixed, False, shade, thickness, cv2.LINE_AA, _SHIFT)

    def arrow(self, start: FloatArray, end: FloatArray, color: Color, *, width: float) -> None:
        """Draw an arrow between two pixels (2,)."""
        along = end - start
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            return
        along = along / length
        head = min(4.5 * width * self.unit, length)
        aside = np.array([-along[1], along[0]]) * head * 0.42
        neck = end - along * head
        triangle = _fixed_point(np.array([end, neck + aside, neck - aside]))
        (_, outer), (_, inner) = self._strokes(color, width=width, casing=_LINE_CASING)
        casing = outer - inner
        self.line(np.array([start, neck]), color, width=width)
        cv2.polylines(self.image, [triangle], True, CASING, casing, cv2.LINE_AA, _SHIFT)
        cv2.fillPoly(self.image, [triangle], color, cv2.LINE_AA, _SHIFT)
        # The shaft again, over the head's casing.
        joint = _fixed_point(np.array([neck - along * casing, neck + along * head * 0.3]))
        cv2.polylines(self.image, [joint], False, color, inner, cv2.LINE_AA, _SHIFT)

    def label(self, text: str, middle: FloatArray, color: Color) -> None:
        """Write a short text about a point."""
        height, width = self.image.shape[:2]
        if not ((middle >= 0) & (middle < (width, height))).all():
            return
        font = ImageFont.load_default(size=15 * self.unit)
        # Only a part of the image goes through Pillow, which copies it twice.
        reach = 20 * self.unit
        left, top = np.maximum(np.floor(middle - reach), 0).astype(int)
        right, bottom = np.ceil(middle + reach).astype(int)
        part = Image.fromarray(self.image[top:bottom, left:right])
        ImageDraw.Draw(part).text(
            (float(middle[0]) - left, float(middle[1]) - top),
            text,
            fill=color,
            font=font,
            anchor="mm",
            stroke_width=max(1, round(self.unit)),
            stroke_fill=CASING,
        )
        self.image[top:bottom, left:right] = np.asarray(part)

    def legend(self, entries: list[LegendEntry], *, keep_clear: FloatArray) -> None:
        """Write a legend into the corner that covers the fewest of some pixels (n, 2)."""
        size = round(12.5 * self.unit)
        font = ImageFont.load_default(size=size)
        pad, swatch, pitch = 0.7 * size, 1.9 * size, 1.45 * size
        width = round(3 * pad + swatch + max(font.getlength(text) for text, _, _ in entries))
        height = round(2 * pad + pitch * len(entries) - (pitch - size))
        rows, columns = self.image.shape[:2]
        if width + size > columns or height + size > rows:
            return
        left, top = self._emptiest_corner(width, height, round(0.7 * size), keep_clear)
        plate = Image.new("L", (width, height), 0)
        ImageDraw.Draw(plate).rounded_rectangle(
            (0, 0, width - 1, height - 1), radius=0.4 * size, fill=round(255 * _PLATE_OPACITY)
        )
        block = (slice(top, top + height), slice(left, left + width))
        part = Image.fromarray(self.image[block])
        part.paste(CASING, (0, 0), plate)
        pen = ImageDraw.Draw(part)
        middles = [pad + size / 2 + pitch * number for number in range(len(entries))]
        for (text, _, _), y in zip(entries, middles, strict=True):
            pen.text((2 * pad + swatch, y), text, fill=(245,) * 3, font=font, anchor="lm")
        self.image[block] = np.asarray(part)
        self._draw_swatches(entries, left + pad, swatch, top + np.array(middles))

    def _draw_swatches(
        self, entries: list[LegendEntry], left: float, width: float, middles: FloatArray
    ) -> None:
        for (_, color, marker), y in zip(entries, middles, strict=True):
            middle = np.array([left + width / 2, y])
            if marker == "ring":
                self.ring(middle, color, radius=4.5)
            elif marker == "cross":
                self.cross(middle, color, radius=4)
            else:
                self.line(np.array([[left, y], [left + width, y]]), color, width=2.5)

    def _emptiest_corner(
        self, width: int, height: int, gap: int, keep_clear: FloatArray
    ) -> tuple[int, int]:
        """Left and top of a plate in the corner where it covers the fewest pixels (n, 2)."""
        rows, columns = self.image.shape[:2]
        corners = [
            (left, top)
            for top in (gap, rows - height - gap)
            for left in (gap, columns - width - gap)
        ]
        covered = [
            ((keep_clear >= corner) & (keep_clear <= (corner[0] + width, corner[1] + height)))
            .all(axis=1)
            .sum()
            for corner in corners
        ]
        return corners[int(np.argmin(covered))]


def _fixed_point(points: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Pixels in OpenCV's whole numbers with a fraction."""
    held = np.clip(points, -_FARTHEST, _FARTHEST)
    return np.asarray(np.rint(held * (1 << _SHIFT)), dtype=np.int32)


def _dashes(points: FloatArray, dash: float, gap: float) -> list[FloatArray]:
    """Cut a line (n, 2) into dashes [px], the first and last of which are whole."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(steps)])
    total = reached[-1]
    count = min(max(1, round((total + gap) / (dash + gap))), 1000)
    pitch = (total + gap) / count
    begins = np.arange(count) * pitch
    ends = np.maximum(begins + (pitch - gap), begins)
    first = np.searchsorted(reached, begins, side="right")
    last = np.searchsorted(reached, ends, side="left")
    at = [
        np.concatenate([[begin], reached[low:high], [end]])
        for begin, end, low, high in zip(begins, ends, first, last, strict=True)
    ]
    every = np.concatenate(at)
    drawn = np.column_stack([np.interp(every, reached, points[:, axis]) for axis in (0, 1)])
    return np.split(drawn, np.cumsum([len(part) for part in at[:-1]]))


LinearArray = npt.NDArray[np.float32]
ByteImage = npt.NDArray[np.uint8]

_STEPS = 1 << 14


def linear_from_srgb(encoded: LinearArray) -> LinearArray:
    """Decode sRGB values (0 to 1, any shape) to linear light; float32."""
    low = encoded / np.float32(12.92)
    high = ((np.maximum(encoded, 0) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.asarray(np.where(encoded <= 0.04045, low, high), dtype=np.float32)


def srgb_from_linear(linear: LinearArray) -> LinearArray:
    """Encode linear light (any shape) to sRGB values from 0 to 1; float32."""
    value = np.clip(linear, 0, 1)
    high = np.float32(1.055) * value ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.asarray(np.where(value <= 0.0031308, value * np.float32(12.92), high), np.float32)


def bytes_from_linear(linear: LinearArray) -> ByteImage:
    """Encode linear light (any shape) to sRGB bytes."""
    index = (np.sqrt(np.clip(linear, 0, 1)) * np.float32(_STEPS) + np.float32(0.5)).astype(np.int32)
    return np.asarray(_encoded_squares()[index])


def linear_from_bytes(image: ByteImage) -> LinearArray:
    """Decode sRGB bytes (any shape) to linear light; float32."""
    return np.asarray(_decoded_bytes()[image])


@cache
def _encoded_squares() -> ByteImage:
    """The bytes of the squares of 0 to 1, which spread the dark values about as sRGB does."""
    grid = (np.arange(_STEPS + 1, dtype=np.float32) / np.float32(_STEPS)) ** 2
    return np.asarray((srgb_from_linear(grid) * 255 + np.float32(0.5)).astype(np.uint8))


@cache
def _decoded_bytes() -> LinearArray:
    return linear_from_srgb(np.arange(256, dtype=np.float32) / np.float32(255))


def composite(color: ByteImage, background: npt.ArrayLike) -> ByteImage:
    """Put an image with opacity (h, w, 4) before a colour or a photo; see `Frame.composite`."""
    behind = np.asarray(background)
    shape = (*color.shape[:2], 3)
    if behind.shape not in ((3,), shape):
        raise InputError(f"shape {behind.shape} is neither (3,) nor {shape}", where="background")
    if behind.dtype.kind not in "ui" or behind.min(initial=0) < 0 or behind.max(initial=0) > 255:
        raise InputError("not whole numbers from 0 to 255", where="background")
    result: ByteImage = np.empty(shape, dtype=np.uint8)
    result[:] = behind
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(color[:, :, 3]))
    block = slice(top, top + height), slice(left, left + width)
    _put_before(result[block], color[block])
    return result


def _put_before(behind: ByteImage, color: ByteImage) -> None:
    """Put an image with opacity (h, w, 4) before a picture (h, w, 3), in place."""
    opacity = color[:, :, 3]
    np.copyto(behind, color[:, :, :3], where=(opacity == 255)[:, :, None])
    mixed = (opacity > 0) & (opacity < 255)
    share = opacity[mixed, None] / np.float32(255)
    light = linear_from_bytes(color[mixed, :3]) * share
    light += linear_from_bytes(behind[mixed]) * (1 - share)
    behind[mixed] = bytes_from_linear(np.asarray(light, dtype=np.float32))
