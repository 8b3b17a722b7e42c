"""Contact sheets, and movies: H.264, VP9 or GIF."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cadalign.errors import InputError, RenderError
from cadalign.io.files import as_path, write_whole
from cadalign.render.drawing.canvas import ByteImage

if TYPE_CHECKING:
    from av import VideoStream

MOVIES = (".mp4", ".webm", ".gif")
"""Endings of the movies that `write_movie` writes."""
_CODECS = ((".mp4", "libx264"), (".webm", "libvpx-vp9"))
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
    """Write a movie: H.264 as ``.mp4``, VP9 as ``.webm``, or an animated ``.gif``.

    Parameters
    ----------
    path : str or path-like
    frames : iterable of (h, w, 3) uint8
        All of one size; in a video an odd row or column is doubled, since it has none.
    fps : float
        Frames a second; a GIF rounds their duration to 10 ms.

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    DataError
        If the file cannot be written.
    InputError
        If there are no frames, they differ in size, or the ending is another.
    RenderError
        If this build of PyAV has no encoder.
    """
    path = as_path(path)
    ending = path.suffix.lower()
    if ending not in MOVIES:
        fix = f"give a name that ends in {', '.join(MOVIES)}"
        raise InputError(f"{path.name} is no movie", where="path", fix=fix)
    write = _write_gif if ending == ".gif" else _write_video
    # Encoders report little about what they cannot write, so the file is moved when it is done.
    checked = _checked(frames)
    first = next(checked, None)
    if first is None:
        raise InputError("no frames are given", where="frames")
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / f"movie{ending}"
        count = write(draft, first, checked, fps)
        write_whole(path, lambda unfinished: shutil.copyfile(draft, unfinished))
    return count


def _checked(frames: Iterable[ByteImage]) -> Iterator[ByteImage]:
    shape = None
    for number, image in enumerate(frames):
        shape = image.shape if shape is None else shape
        if image.shape != shape:
            raise InputError(f"frame {number} is {image.shape}, not {shape}", where="frames")
        yield image


def _write_gif(path: Path, first: ByteImage, frames: Iterator[ByteImage], fps: float) -> int:
    """Write an endless GIF; returns the number of frames."""
    rest = [Image.fromarray(image).quantize(256) for image in frames]
    Image.fromarray(first).quantize(256).save(
        path,
        save_all=True,
        append_images=rest,
        duration=max(20, 10 * round(100 / fps)),  # browsers slow down what is faster
        loop=0,
    )
    return 1 + len(rest)


def _write_video(path: Path, first: ByteImage, frames: Iterator[ByteImage], fps: float) -> int:
    """Write a video that browsers play; returns the number of frames."""
    import av  # on first use: it brings FFmpeg with it

    height, width = _even(first).shape[:2]
    codec = next((name for ending, name in _CODECS if ending == path.suffix), None)
    if codec is None or codec not in av.codecs_available:
        raise RenderError(
            "PyAV cannot encode video here",
            where=str(path),
            fix="install av from PyPI, or write a GIF or PNG",
        )
    count = 0
    options = {"movflags": "faststart"} if path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=options) as container:
        rate = Fraction(fps).limit_denominator(1001)
        stream = cast("VideoStream", container.add_stream(codec, rate=rate))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "20" if path.suffix == ".mp4" else "30", "b": "0"}
        for image in chain([first], frames):
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(_even(image)), format="rgb24")
            container.mux(stream.encode(picture))
            count += 1
        container.mux(stream.encode())
    return count


def _even(image: ByteImage) -> ByteImage:
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
