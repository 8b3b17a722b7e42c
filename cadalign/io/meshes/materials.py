"""Materials of mesh files: MTL libraries, and textures in files or in the mesh's file."""

from __future__ import annotations

import io
import logging
import math
import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DataError, brief, quote
from cadalign.geometry.mesh import GREY, Material
from cadalign.io.files import protect_input, read_text
from cadalign.io.images import open_photo, open_picture

logger = logging.getLogger("cadalign")

Texture = npt.NDArray[np.uint8]
_Entry = dict[str, list[str]]

WHITE = (1.0, 1.0, 1.0, 1.0)
_MOST_BYTES = 2**30  # limit of a mesh's decoded textures


def load_materials(
    obj_path: Path, libraries: Iterable[str], names: Iterable[str]
) -> dict[str, Material]:
    """Read materials by name; a missing one becomes grey with a warning.

    ``libraries`` are the names in the OBJ file's ``mtllib`` lines. Only textures of the named
    materials are read.
    """
    entries: dict[str, tuple[Path, _Entry]] = {}
    for library in dict.fromkeys(libraries):
        path = find_reference(obj_path, library)
        try:
            parsed = _parse_library(read_text(path, errors="replace"))
        except DataError as error:
            given = obj_path, brief(library), error.what
            logger.warning("%s: the material library %s cannot be read (%s)", *given)
            continue
        protect_input(path)
        entries |= {name: (path, entry) for name, entry in parsed.items()}
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


def _parse_library(text: str) -> dict[str, _Entry]:
    """Parse a library: materials by name, each with the words after its keywords."""
    entries: dict[str, _Entry] = {}
    current: _Entry = {}  # lines before the first material
    for line in text.splitlines():
        key, *words = line.split() or [""]
        if key.lower() == "newmtl":
            current = entries[" ".join(words)] = {}
        elif words:
            current[key.lower()] = words
    return entries


def _material(name: str, library: Path, entry: _Entry, textures: Textures) -> Material:
    rgb, opacity, transparency = (_fractions(entry.get(key, ())) for key in ("kd", "d", "tr"))
    red, green, blue = rgb[:3] if len(rgb) >= 3 else GREY[:3]
    alpha = opacity[-1] if opacity else 1.0 - transparency[-1] if transparency else 1.0
    texture = None
    if words := entry.get("map_kd"):
        # Options, such as "-s 1 1 1", precede the file's name, which may have blanks.
        files = [find_reference(library, " ".join(words[start:])) for start in range(len(words))]
        file = next(filter(os.path.isfile, files), files[0])
        texture = textures.read(file, name=file.name, within=library)
        if texture is None:
            red, green, blue, _ = GREY
        elif not red and not green and not blue:
            # Exporters write a black Kd beside a texture; the product would be black.
            red, green, blue, _ = WHITE
    return Material(name=name, color=(red, green, blue, alpha), texture=texture)


def _fractions(words: Sequence[str]) -> list[float]:
    """Parse the finite numbers among words, such as ``-halo 0.5``, clipped to 0 and 1."""
    found: list[float] = []
    for word in words:
        with suppress(ValueError):
            found.append(float(word))
    return [min(max(each, 0.0), 1.0) for each in found if math.isfinite(each)]


@dataclass
class Textures:
    """Textures of one mesh, each read once, with at most a gigabyte of pixels in total."""

    _known: dict[Path | str, Texture | None] = field(default_factory=dict)
    _bytes_left: int = _MOST_BYTES

    def read(self, picture: Path | bytes, *, name: str, within: Path) -> Texture | None:
        """Read a texture, (h, w, 3 or 4) uint8, from a file or from bytes of the mesh's file.

        A texture that is missing or cannot be read becomes None with a warning (logger "cadalign").
        """
        key = picture if isinstance(picture, Path) else name
        if key not in self._known:
            self._known[key] = None
            try:
                self._known[key] = self._pixels(picture, within)
            except Exception as error:  # Pillow's decoders raise any error on damaged files
                reason = error.what if isinstance(error, CadalignError) else brief(error)
                given = within, brief(name), reason
                logger.warning("%s: the texture %s cannot be read (%s); drawn grey", *given)
        return self._known[key]

    def _pixels(self, picture: Path | bytes, within: Path) -> Texture:
        if isinstance(picture, Path):
            protect_input(picture)
            opened = open_photo(picture)
        else:
            opened = open_picture(io.BytesIO(picture), len(picture), where=str(within))
        with opened as image, warnings.catch_warnings(action="ignore"):
            transparent = "A" in image.getbands() or "transparency" in image.info
            mode = "RGBA" if transparent else "RGB"
            self._bytes_left -= len(mode) * image.width * image.height
            if self._bytes_left < 0:
                raise DataError("the textures of this mesh have more than a gigabyte of pixels")
            return np.asarray(image.convert(mode))


def find_reference(path: Path, name: str) -> Path:
    r"""Find the file that another file names relative to its folder.

    The name may have ``\`` for ``/``; its folders are ignored if only the plain name exists.
    """
    plain = name.replace("\\", "/")
    places = [path.parent / each for each in (name, plain, PurePosixPath(plain).name)]
    return next(filter(os.path.isfile, places), places[0])


def vertex_colors(values: FloatArray) -> FloatArray:
    """Convert a file's colours (n, 3 or 4) to (n, 4) in 0 to 1; NaN becomes 1."""
    colors = np.ones((len(values), 4))
    colors[:, : values.shape[1]] = np.nan_to_num(np.clip(values, 0, 1), nan=1.0)
    return colors
