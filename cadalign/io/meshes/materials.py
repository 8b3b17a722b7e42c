"""Materials of mesh files: MTL libraries, and the pictures that materials name or hold."""

from __future__ import annotations

import io
import logging
import math
import warnings
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.errors import CadalignError, DataError, brief, quote
from cadalign.geometry.mesh import GREY, Material
from cadalign.io.files import keep, read_text
from cadalign.io.images import open_photo, open_picture

if TYPE_CHECKING:
    from PIL.Image import Image


logger = logging.getLogger("cadalign")

_Entry = dict[str, list[str]]

WHITE = (1.0, 1.0, 1.0, 1.0)


def load_materials(
    obj_path: Path, libraries: Iterable[str], names: Iterable[str]
) -> dict[str, Material]:
    """Read the named materials; what is missing is warned of and becomes grey.

    ``libraries`` is what the OBJ file's ``mtllib`` lines name; only the textures of ``names`` are
    read.
    """
    entries: dict[str, tuple[Path, _Entry]] = {}
    for library in dict.fromkeys(libraries):
        if path := find_file(obj_path.parent, library):
            entries |= {name: (path, entry) for name, entry in _parse_library(path).items()}
        else:
            logger.warning("%s: no material library %s beside it", obj_path, brief(library))
    found: dict[str, Material] = {}
    textures = Textures()
    for name in names:
        # The parser joins the words of a name with single blanks.
        key = " ".join(name.split())
        if key in entries:
            found[name] = _material(name, *entries[key], textures)
        else:
            logger.warning("%s: material %s is not defined; it becomes grey", obj_path, quote(name))
            found[name] = Material(name=name)
    return found


def _parse_library(path: Path) -> dict[str, _Entry]:
    """The materials of a library by name: of each, the words that follow its keywords."""
    keep(path)
    try:
        text = read_text(path, errors="replace")
    except DataError as error:
        logger.warning("%s: the material library cannot be read (%s)", path, error.what)
        return {}
    entries: dict[str, _Entry] = {}
    current: _Entry = {}  # of what stands before the first name
    for line in text.splitlines():
        key, *words = line.split() or [""]
        if not words:
            continue
        if key.lower() == "newmtl":
            current = entries[" ".join(words)] = {}
        else:
            current[key.lower()] = words
    return entries


def _material(name: str, path: Path, entry: _Entry, textures: Textures) -> Material:
    texture, color = None, _color(entry)
    if words := entry.get("map_kd"):
        # Options, such as "-s 1 1 1", stand before the file, whose name may have blanks.
        files = [" ".join(words[start:]) for start in range(len(words))]
        file = next((each for each in files if _find_texture(path.parent, each)), files[0])
        texture = textures.read(path, file)
        if texture is None:
            color = (*GREY[:3], color[3])
        elif not any(color[:3]):
            # Exporters write a black Kd beside a texture; multiplied, the texture would vanish.
            color = (1.0, 1.0, 1.0, color[3])
    return Material(name=name, color=color, texture=texture)


def _color(entry: _Entry) -> tuple[float, float, float, float]:
    rgb, opacity, transparency = (_numbers(entry.get(key, ())) for key in ("kd", "d", "tr"))
    alpha = opacity[-1] if opacity else 1.0 - transparency[-1] if transparency else 1.0
    known = rgb[:3] if len(rgb) >= 3 else GREY[:3]
    red, green, blue, alpha = np.clip([*known, alpha], 0.0, 1.0).tolist()
    return red, green, blue, alpha


def _numbers(words: Sequence[str]) -> list[float]:
    """The finite numbers among words, such as those of ``d -halo 0.5``."""
    found: list[float] = []
    for word in words:
        with suppress(ValueError):
            found.append(float(word))
    return [each for each in found if math.isfinite(each)]


Texture = npt.NDArray[np.uint8]

_MOST_BYTES = 2**30  # of the pixels of a mesh's textures


@dataclass
class Textures:
    """The textures of one mesh, each read once, of at most a gigabyte of pixels in all.

    What is missing or cannot be read is warned of (logger "cadalign") and becomes None.
    """

    _known: dict[Path | str, Texture | None] = field(default_factory=dict)
    _bytes_left: int = _MOST_BYTES

    def read(self, beside: Path, name: str) -> Texture | None:
        """Read the picture that a file names, (h, w, 3 or 4) uint8.

        One that is not where it is named is looked for beside the file.
        """
        found = _find_texture(beside.parent, name)
        path = beside.parent / name if found is None else found.resolve()
        if path not in self._known:
            self._known[path] = None
            if found is None:
                logger.warning("%s: the texture %s is missing; drawn grey", beside, brief(name))
            else:
                keep(found)
                self._known[path] = self._pixels(open_photo(found), beside, name)
        return self._known[path]

    def decode(self, data: bytes, *, within: Path, name: str) -> Texture | None:
        """Decode a picture that is a part of a file, (h, w, 3 or 4) uint8."""
        if name not in self._known:
            opened = open_picture(io.BytesIO(data), len(data), where=str(within))
            self._known[name] = self._pixels(opened, within, name)
        return self._known[name]

    def _pixels(
        self, opened: AbstractContextManager[Image], path: Path, name: str
    ) -> Texture | None:
        try:
            with opened as image, warnings.catch_warnings(action="ignore"):
                transparent = "A" in image.getbands() or "transparency" in image.info
                mode = "RGBA" if transparent else "RGB"
                self._bytes_left -= len(mode) * image.width * image.height
                if self._bytes_left < 0:
                    raise DataError("the textures of this mesh have more than a gigabyte of pixels")
                return np.asarray(image.convert(mode))
        except Exception as error:  # Pillow's decoders raise what they like on damaged files
            reason = error.what if isinstance(error, CadalignError) else brief(error)
            given = path, brief(name), reason
            logger.warning("%s: the texture %s cannot be read (%s); drawn grey", *given)
            return None


def find_file(folder: Path, name: str) -> Path | None:
    """The file of this name relative to the folder, also if it is written with backslashes."""
    for spelling in (name, name.replace("\\", "/")):
        with suppress(OSError, ValueError):
            if spelling and (folder / spelling).is_file():
                return folder / spelling
    return None


def _find_texture(folder: Path, name: str) -> Path | None:
    return find_file(folder, name) or find_file(folder, PurePosixPath(name).name)
