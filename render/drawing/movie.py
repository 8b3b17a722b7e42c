"""Contact sheets, and movies that need no program beside OpenCV."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cadalign.errors import InputError, RenderError
from cadalign.io.files import write_whole
from cadalign.render.drawing.color import ByteImage

# Browsers play VP9; MPEG-4 part 2 is what every build of OpenCV can write.
_CODECS = ("vp09", "mp4v")
_TEXT = (70, 76, 84)


def contact_sheet(
    images: Sequence[ByteImage],
    labels: Sequence[str],
    *,
    columns: int | None = None,
    background: tuple[int, int, int] = (255, 255, 255),
) -> ByteImage:
    """Put pictures of one size side by side, each with a label beneath.

    Parameters
    ----------
    images : sequence of (h, w, 3) uint8
    labels : sequence of str
    columns : int, optional
        By default about as many as rows.
    background : tuple of 3 int

    Returns
    -------
    (H, W, 3) uint8

    Raises
    ------
    InputError
        If there are no images, they differ in size, or there is not a label for each.
    """
    if not images or len(images) != len(labels):
        raise InputError(f"{len(images)} images and {len(labels)} labels", where="images")
    if len({image.shape for image in images}) > 1:
        raise InputError("all must have the same size", where="images")
    height, width = images[0].shape[:2]
    across = columns or int(np.ceil(np.sqrt(len(images))))
    down = -(-len(images) // across)
    gap = max(4, min(height, width) // 40)
    line = max(14, height // 16)
    size = (across * (width + gap) + gap, down * (height + line + gap) + gap)
    sheet = Image.new("RGB", size, background)
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=0.72 * line)
    for number, (image, label) in enumerate(zip(images, labels, strict=True)):
        left = gap + number % across * (width + gap)
        top = gap + number // across * (height + line + gap)
        sheet.paste(Image.fromarray(image), (left, top))
        middle = (left + width / 2, top + height + line / 2)
        pen.text(middle, label, fill=_TEXT, font=font, anchor="mm")
    return np.array(sheet)


def write_movie(path: str | os.PathLike[str], frames: Iterable[ByteImage], *, fps: float) -> int:
    """Write an MP4 file.

    Parameters
    ----------
    path : str or path-like
    frames : iterable of (h, w, 3) uint8
        All of one size; an odd row or column is doubled, since video has none.
    fps : float
        Frames a second.

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    DataError
        If the file cannot be written.
    InputError
        If there are no frames or they differ in size.
    RenderError
        If this build of OpenCV has no encoder.
    """
    path = Path(path)
    writer, count, shape = None, 0, None
    # The encoder reports nothing about what it cannot write, so the file is moved when it is done.
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "movie.mp4"
        try:
            for image in frames:
                if writer is None:
                    shape = image.shape
                    writer = _open_writer(draft, image, fps)
                if image.shape != shape:
                    raise InputError(f"frame {count} is {image.shape}, not {shape}", where="frames")
                writer.write(_even(image)[:, :, ::-1].copy())
                count += 1
        finally:
            if writer is not None:
                writer.release()
        if not count:
            raise InputError("no frames are given", where="frames")
        write_whole(path, lambda unfinished: shutil.copyfile(draft, unfinished))
    return count


def _open_writer(path: Path, image: ByteImage, fps: float) -> cv2.VideoWriter:
    height, width = _even(image).shape[:2]
    for codec in _CODECS:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (width, height))
        if writer.isOpened():
            return writer
        writer.release()
    raise RenderError(
        "OpenCV cannot encode video here",
        where=str(path),
        fix="install opencv-python-headless from PyPI, or write a PNG",
    )


def _even(image: ByteImage) -> ByteImage:
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
