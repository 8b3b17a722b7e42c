"""Read images upright, as EXIF says they were held, and write them."""

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
"""Formats of pictures that are read, by Pillow's names; PPM stands for PGM and PBM as well."""
JPEG_ENDING = ".jpg"
_JPEG_QUALITY = 95

_ORIENTATION = 0x0112
_ON_ITS_SIDE = frozenset((5, 6, 7, 8))
# Deflate compresses bytes to 1/1032 at most; images of one bit per pixel grow further when decoded.
_COMPRESSION = 1032
_FREE_BYTES = 2**26


@contextmanager
def open_photo(path: str | os.PathLike[str]) -> Iterator[Image]:
    """Open a photo; its pixels are decoded when they are asked for, errors then named as well."""
    path = as_path(path)
    refuse_other_file(path, PHOTO)
    data = read_bytes(path)
    with open_picture(io.BytesIO(data), len(data), where=str(path)) as image:
        yield image


@contextmanager
def open_picture(file: BinaryIO, size: int, *, where: str) -> Iterator[Image]:
    """Open a picture of ``size`` bytes, of one of `FORMATS`: every picture is decoded here.

    Left to itself, Pillow goes by the content and tries all the formats that it knows; of some,
    such as EPS, it starts other programs.

    Raises DataError if it is of another format, damaged, or has far more pixels than its bytes can
    describe: more than 64 MB and 1032 times the bytes, the most that PNG compresses.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's about EXIF data of which it skips a part
            with Image.open(file, formats=FORMATS) as image:
                if 3 * image.width * image.height > _FREE_BYTES + _COMPRESSION * size:
                    raise ValueError(f"{image.width} x {image.height} pixels in {size} bytes")
                yield image
    except Image.DecompressionBombError:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0) // 10**6
        what, fix = f"the image has more than {most} megapixels", "make it smaller"
        raise DataError(what, where=where, fix=fix) from None
    except UnidentifiedImageError:
        reason = f"it begins like none of {', '.join(FORMATS)}"
        raise DataError(f"not an image that can be read ({reason})", where=where) from None
    # SyntaxError: Pillow's word for a broken PNG; the last two, for numbers of a TIFF or of EXIF.
    except (OSError, ValueError, SyntaxError, TypeError, struct.error) as error:
        what = f"not an image that can be read ({brief(error)})"
        raise DataError(what, where=where) from None


def read_photo(path: str | os.PathLike[str]) -> ByteImage:
    """Read a photo as RGB (h, w, 3) uint8, turned upright where EXIF says how it was held.

    It is of one of the `FORMATS`, whatever its name ends in.
    """
    with open_photo(path) as image:
        return upright_pixels(image)


def upright_pixels(image: Image) -> ByteImage:
    """The pixels of an open photo as `read_photo` returns them."""
    from PIL import ImageOps

    upright = ImageOps.exif_transpose(image)
    if not upright.mode.startswith("I"):
        return np.asarray(upright.convert("RGB"))
    # Of 16 bits, which Pillow would cut off at 255.
    grey = (np.clip(np.asarray(upright), 0, 0xFFFF) >> 8).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def photo_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height [px] of a photo turned upright; its pixels are not decoded."""
    with open_photo(path) as image:
        width, height = image.size
        is_on_its_side = image.getexif().get(_ORIENTATION) in _ON_ITS_SIDE
    return (height, width) if is_on_its_side else (width, height)


def exif_note(path: Path, size: tuple[int, int]) -> str:
    """A note about a photo of another size than this (width, height), if EXIF turned it."""
    with open_photo(path) as image:
        if image.size != size or photo_size(path) == size:
            return ""
    return (
        f"; its EXIF data say that it was held on its side: as it is stored, it has {size[0]} x "
        f"{size[1]} pixels, but it is read upright, as photo programs show it"
    )


def require_one_size(sizes: Mapping[str, tuple[int, int]], photo: Path | None) -> None:
    """Refuse parts of an image that differ in size (width, height), by their names.

    The ``photo`` is one of them.
    """
    (first, size), *others = sizes.items()
    for name, other in others:
        if other != size:
            note = "" if photo is None else exif_note(photo, other) or exif_note(photo, size)
            raise DataError(
                f"the image has {other[0]} x {other[1]} pixels, that of {first} "
                f"{size[0]} x {size[1]}{note}",
                where=name,
                fix="give keypoints, photo and camera of one image",
            )


def read_image(path: Path, camera: Camera) -> ByteImage:
    """Read a photo as `read_photo` does and require the camera's size of it."""
    pixels = read_photo(path)
    size = pixels.shape[1], pixels.shape[0]
    require_one_size({"its camera": (camera.width, camera.height), str(path): size}, path)
    return pixels


def read_grey(path: Path) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """Read an image of one channel of 8 or 16 bits as it is stored, (h, w).

    A JPEG is refused: its compression leaves traces on both sides of every edge.
    """
    with open_photo(path) as image:
        mode, form = image.mode, image.format
        pixels = np.asarray(image.convert("L") if mode in ("1", "P") else image)
    is_grey = pixels.ndim == 2 and (mode.startswith("I") or mode in ("1", "L", "P"))
    if not is_grey or form == "JPEG":
        what = f"the image is a {form} of the mode {brief(mode)}"
        what += ", whose compression changes values" if is_grey else ""
        fix = "give a PNG of one grey channel, of 8 or 16 bits"
        raise DataError(what, where=str(path), fix=fix)
    return pixels if pixels.dtype == np.uint8 else pixels.astype(np.uint16)


def read_mask(path: Path) -> BoolArray:
    """Read an object's pixels (h, w): those that are not zero, as `read_grey` reads them."""
    return np.asarray(read_grey(path) > 0)


def write_image(path: Path, image: ByteImage) -> None:
    """Write an image, whole or not at all: RGB (h, w, 3) uint8, RGBA (h, w, 4) or grey.

    As JPEG where the name ends in ``.jpg``, otherwise as PNG.
    """
    from PIL import Image

    form = "JPEG" if path.suffix.lower() == JPEG_ENDING else "PNG"
    how = {"quality": _JPEG_QUALITY, "compress_level": 1}  # each is of one of the two
    write_whole(path, lambda unfinished: Image.fromarray(image).save(unfinished, form, **how))
