"""Linear light and sRGB, the encoding of image files (IEC 61966-2-1)."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.errors import InputError

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
    """The linear light of every byte."""
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
