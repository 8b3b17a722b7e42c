"""Pictures of a video: the frames of a file, or the photos of a folder, by their number."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.errors import DataError, brief
from cadalign.io.files import open_input, reading
from cadalign.io.images import ByteImage, photo_size, read_photo

if TYPE_CHECKING:
    from av.container import InputContainer

_PHOTOS = frozenset((".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"))
_MOST_BYTES = 2**40


@dataclass(frozen=True)
class Video:
    """A video whose pictures are read when they are asked for.

    Parameters
    ----------
    path : Path
        A file that FFmpeg reads, or a folder of photos.
    size : tuple of 2 int
        Width and height of its pictures, as they are seen [px].
    rate : float or None
        Frames in a second; None where the video does not say.
    """

    path: Path
    size: tuple[int, int]
    rate: float | None

    @classmethod
    def open(cls, path: Path) -> Video:
        """Look at a video file, or a folder of photos.

        Raises
        ------
        DataError
            If it cannot be read, or has no pictures.
        """
        if path.is_dir():
            return cls(path, photo_size(_photos(path)[0]), None)
        with _opened(path) as container:
            rate = container.streams.video[0].average_rate
            first = next(_upright(container), None)
        if first is None:
            raise DataError("there is no picture in it", where=str(path))
        height, width = first.shape[:2]
        return cls(path, (width, height), None if rate is None else float(rate))

    def pictures(self, *, first: int = 0) -> Iterator[tuple[int, ByteImage]]:
        """Read the pictures (h, w, 3) in their order, each with its frame's number.

        Those of a file are counted from ``first``; those of a folder have the number in their name,
        see `frame_numbers`.

        Raises
        ------
        DataError
            If a picture cannot be read.
        """
        if self.path.is_dir():
            photos = _photos(self.path)
            numbers = frame_numbers([photo.name for photo in photos])
            for photo in sorted(photos, key=lambda each: numbers[each.name]):
                yield numbers[photo.name], read_photo(photo)
            return
        with _opened(self.path) as container:
            yield from enumerate(_upright(container), start=first)


def frame_numbers(images: Iterable[str]) -> dict[str, int]:
    """Number of each image: the last one in its name, or its place where some have none.

    Numbers are those of one video, whose images have a folder of their own.

    Examples
    --------
    >>> frame_numbers(["left/cam2_0007.png", "left/cam2_0009.png", "right/cam2_0007.png"])
    {'left/cam2_0007.png': 7, 'left/cam2_0009.png': 9, 'right/cam2_0007.png': 7}
    """
    distinct = list(dict.fromkeys(images))
    found = [re.findall(r"\d+", Path(image).stem) for image in distinct]
    numbers = [int(each[-1]) if each else -1 for each in found]
    folders = [Path(image).parent for image in distinct]
    pairs = set(zip(folders, numbers, strict=True))
    if min(numbers, default=0) < 0 or len(pairs) < len(numbers):
        numbers = list(range(len(distinct)))
    return dict(zip(distinct, numbers, strict=True))


def _photos(folder: Path) -> list[Path]:
    with reading(folder):
        found = sorted(each for each in folder.iterdir() if each.suffix.lower() in _PHOTOS)
    if not found:
        raise DataError("there is no photo in it", where=str(folder), fix="give PNG or JPEG files")
    return found


@contextmanager
def _opened(path: Path) -> Iterator[InputContainer]:
    """The file, opened for its first video; whatever is wrong with it is a DataError."""
    import av  # on first use: it brings FFmpeg with it

    with open_input(path, most=_MOST_BYTES) as file:
        try:
            with av.open(file, "r") as container:
                if not container.streams.video:
                    raise DataError("there is no video in it", where=str(path))
                yield container
        except av.FFmpegError as error:
            what = f"not a video that can be read ({brief(error)})"
            raise DataError(what, where=str(path)) from None


def _upright(container: InputContainer) -> Iterator[ByteImage]:
    """The pictures, turned as the file says that they are to be seen."""
    for frame in container.decode(video=0):
        turns = round(getattr(frame, "rotation", 0) / 90)
        yield np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), turns))
