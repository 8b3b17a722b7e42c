"""Read images, turned upright by their EXIF orientation, and write images."""

from __future__ import annotations

import io
import os
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray
from cadalign.errors import DataError, brief
from cadalign.geometry.camera import Camera
from cadalign.io.files import as_path, read_bytes, write_whole
from cadalign.io.kinds import PHOTO, refuse_other_file

if TYPE_CHECKING:
    from PIL.Image import Image


ByteImage = npt.NDArray[np.uint8]
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "GIF", "TGA", "PPM")
"""Supported picture formats, by Pillow's names; PPM includes PGM and PBM."""
JPEG_ENDING = ".jpg"
_JPEG_QUALITY = 95

_ORIENTATION = 0x0112
_SIDEWAYS = frozenset((5, 6, 7, 8))
# Deflate compresses to 1/1032 at most; images of one bit per pixel grow further when decoded.
_COMPRESSION = 1032
_FREE_BYTES = 2**26


@contextmanager
def open_photo(path: str | os.PathLike[str]) -> Iterator[Image]:
    """Open a photo; pixels are decoded on access within the block, where errors name the file."""
    path = as_path(path)
    refuse_other_file(path, PHOTO)
    data = read_bytes(path)
    with open_picture(io.BytesIO(data), len(data), where=str(path)) as image:
        yield image


@contextmanager
def open_picture(file: BinaryIO, size: int, *, where: str) -> Iterator[Image]:
    """Open a picture of ``size`` bytes in one of `FORMATS`; all pictures are decoded here.

    Without the restriction, Pillow tries all of its formats; for some, such as EPS, it starts other
    programs.

    Raises DataError if the picture has another format, is damaged, or has too many pixels for its
    size: more than 64 MB plus 1032 times its bytes, the maximum compression of PNG.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of EXIF data that it skips
            with Image.open(file, formats=FORMATS) as image:
                if 3 * image.width * image.height > _FREE_BYTES + _COMPRESSION * size:
                    raise ValueError(f"{image.width} x {image.height} pixels in {size} bytes")
                yield image
    except Image.DecompressionBombError:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0) // 10**6
        what, fix = f"the image has more than {most} megapixels", "make it smaller"
        raise DataError(what, where=where, fix=fix) from None
    except UnidentifiedImageError:
        reason = f"its content is none of {', '.join(FORMATS)}"
        raise DataError(f"not an image that can be read ({reason})", where=where) from None
    # Pillow raises SyntaxError for a broken PNG, the last two for numbers in TIFF or EXIF data.
    except (OSError, ValueError, SyntaxError, TypeError, struct.error) as error:
        what = f"not an image that can be read ({brief(error)})"
        raise DataError(what, where=where) from None


def read_photo(path: str | os.PathLike[str]) -> ByteImage:
    """Read a photo as RGB (h, w, 3) uint8, turned upright by its EXIF orientation.

    Its content must have one of the `FORMATS`; the ending of its name is not considered.
    """
    with open_photo(path) as image:
        return upright_pixels(image)


def upright_pixels(image: Image) -> ByteImage:
    """Decode an open photo; returns the same as `read_photo`."""
    from PIL import ImageOps

    upright = ImageOps.exif_transpose(image)
    if not upright.mode.startswith("I"):
        return np.asarray(upright.convert("RGB"))
    # Pillow would clip 16-bit values at 255.
    grey = (np.clip(np.asarray(upright), 0, 0xFFFF) >> 8).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def photo_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Read width and height [px] of a photo turned upright; its pixels are not decoded."""
    with open_photo(path) as image:
        width, height = image.size
        is_sideways = image.getexif().get(_ORIENTATION) in _SIDEWAYS
    return (height, width) if is_sideways else (width, height)


def exif_note(path: Path, size: tuple[int, int]) -> str:
    """A note for messages if ``size`` (width, height) is the photo's size before EXIF turned it."""
    with open_photo(path) as image:
        if image.size != size or photo_size(path) == size:
            return ""
    return (
        f"; the photo is stored with {size[0]} x {size[1]} pixels, but is read turned upright by "
        "its EXIF orientation, as photo programs show it"
    )


def require_one_size(sizes: Mapping[str, tuple[int, int]], photo: Path | None) -> None:
    """Raise DataError unless all named sizes (width, height) are equal.

    If one of them is a photo's, ``photo`` is its file.
    """
    (first, size), *others = sizes.items()
    for name, other in others:
        if other != size:
            note = "" if photo is None else exif_note(photo, other) or exif_note(photo, size)
            raise DataError(
                f"the image has {other[0]} x {other[1]} pixels, but {first} has "
                f"{size[0]} x {size[1]}{note}",
                where=name,
                fix="give keypoints, photo and camera of the same image",
            )


def read_image(path: Path, camera: Camera) -> ByteImage:
    """Read a photo as `read_photo` does; raises DataError if its size is not the camera's."""
    pixels = read_photo(path)
    size = pixels.shape[1], pixels.shape[0]
    require_one_size({"its camera": (camera.width, camera.height), str(path): size}, path)
    return pixels


def read_grey(path: Path) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """Read an image of one channel of 8 or 16 bits as stored, (h, w).

    A JPEG is refused: its compression changes values near edges.
    """
    with open_photo(path) as image:
        mode, form = image.mode, image.format
        pixels = np.asarray(image.convert("L") if mode in ("1", "P") else image)
    is_grey = pixels.ndim == 2 and (mode.startswith("I") or mode in ("1", "L", "P"))
    if not is_grey or form == "JPEG":
        what = f"the image is a {form} of mode {brief(mode)}"
        what += ", whose compression changes values" if is_grey else ""
        fix = "give a PNG of one grey channel, of 8 or 16 bits"
        raise DataError(what, where=str(path), fix=fix)
    return pixels if pixels.dtype == np.uint8 else pixels.astype(np.uint16)


def read_mask(path: Path) -> BoolArray:
    """Read an object's mask (h, w): the pixels of `read_grey` that are not zero."""
    return np.asarray(read_grey(path) > 0)


def write_image(path: Path, image: ByteImage) -> None:
    """Write an image atomically: RGB (h, w, 3) uint8, RGBA (h, w, 4) or grey (h, w).

    The format is JPEG if the name ends in ``.jpg``, otherwise PNG.
    """
    from PIL import Image

    form = "JPEG" if path.suffix.lower() == JPEG_ENDING else "PNG"
    how = {"quality": _JPEG_QUALITY, "compress_level": 1}  # for JPEG, for PNG
    write_whole(path, lambda unfinished: Image.fromarray(image).save(unfinished, form, **how))
