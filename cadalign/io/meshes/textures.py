"""The pictures that the materials of mesh files name, or hold."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.errors import CadalignError, DataError, brief
from cadalign.io.images import open_photo, open_picture

if TYPE_CHECKING:
    from PIL.Image import Image

logger = logging.getLogger("cadalign")

Texture = npt.NDArray[np.uint8]

_MOST_BYTES = 2**30  # of the pixels of a mesh's textures


@dataclass
class Textures:
    """The textures of one mesh, each read once, of at most a gigabyte of pixels in all.

    What is missing or cannot be read is warned of (logger "cadalign") and becomes None.
    """

    _of_name: dict[tuple[Path, str], Texture | None] = field(default_factory=dict)
    _of_file: dict[Path, Texture | None] = field(default_factory=dict)
    _bytes_left: int = _MOST_BYTES

    def read(self, beside: Path, name: str) -> Texture | None:
        """Read the picture that a file names, (h, w, 3 or 4) uint8.

        One that is not where it is named is looked for beside the file.
        """
        key = beside, name
        if key not in self._of_name:
            self._of_name[key] = self._read(beside, name)
        return self._of_name[key]

    def _read(self, beside: Path, name: str) -> Texture | None:
        found = find_file(beside.parent, name) or find_file(beside.parent, PurePosixPath(name).name)
        if found is None:
            logger.warning("%s: the texture %s is missing; drawn grey", beside, brief(name))
            return None
        path = found.resolve()
        if path not in self._of_file:
            self._of_file[path] = None
            with _left_out(beside, name), open_photo(found) as image:
                self._of_file[path] = self._pixels(image)
        return self._of_file[path]

    def decode(self, data: bytes, *, within: Path, name: str) -> Texture | None:
        """Decode a picture that is a part of a file, (h, w, 3 or 4) uint8."""
        file = io.BytesIO(data)
        with _left_out(within, name), open_picture(file, len(data), where=str(within)) as image:
            return self._pixels(image)

    def _pixels(self, image: Image) -> Texture:
        """The pixels, with opacity where the picture has transparency."""
        transparent = "A" in image.getbands() or "transparency" in image.info
        mode = "RGBA" if transparent else "RGB"
        size = len(mode) * image.width * image.height
        if size > self._bytes_left:
            raise DataError("the textures of this mesh have more than a gigabyte of pixels")
        self._bytes_left -= size
        with warnings.catch_warnings(action="ignore"):
            return np.asarray(image.convert(mode))


def find_file(folder: Path, name: str) -> Path | None:
    """The file of this name relative to the folder, also if it is written with backslashes."""
    for spelling in (name, name.replace("\\", "/")):
        try:
            if spelling and (folder / spelling).is_file():
                return folder / spelling
        except (OSError, ValueError):
            continue
    return None


@contextmanager
def _left_out(path: Path, name: str) -> Iterator[None]:
    """Warn of a texture that cannot be read; what would return it returns None."""
    try:
        yield
    except Exception as error:  # Pillow's decoders raise what they like on damaged files
        reason = error.what if isinstance(error, CadalignError) else brief(error)
        given = path, brief(name), reason
        logger.warning("%s: the texture %s cannot be read (%s); drawn grey", *given)
