"""Materials of mesh files: MTL libraries, and the pictures that materials name or hold."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
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
_SWITCHES = ("on", "off")  # values of options of map_Kd


def load_materials(
    obj_path: Path, libraries: Iterable[str], names: Iterable[str]
) -> dict[str, Material]:
    """Read the named materials; what is missing is warned of and becomes grey.

    ``libraries`` is what the OBJ file's ``mtllib`` lines name; only the textures of ``names`` are
    read.
    """
    paths = (path for library in dict.fromkeys(libraries) for path in _paths(obj_path, library))
    entries: dict[str, tuple[Path, _Entry]] = {}
    for path in {path.resolve(): path for path in paths}.values():
        entries |= {name: (path, entry) for name, entry in _parse_library(path).items()}
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


def _paths(obj_path: Path, library: str) -> Iterator[Path]:
    """The files that an ``mtllib`` line names: one with blanks in its name, or several."""
    whole = find_file(obj_path.parent, library)
    for name in library.split() if whole is None else [library]:
        if path := find_file(obj_path.parent, name):
            yield path
        else:
            logger.warning("%s: no material library %s beside it", obj_path, brief(name))


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
    words = _without_options(entry.get("map_kd", []))
    texture = textures.read(path, " ".join(words)) if words else None
    color = _color(entry)
    if texture is None and "map_kd" in entry:
        color = (*GREY[:3], color[3])
    elif texture is not None and not any(color[:3]):
        # Exporters write a black Kd beside a texture; multiplied, the texture would vanish.
        color = (1.0, 1.0, 1.0, color[3])
    return Material(name=name, color=color, texture=texture)


def _color(entry: _Entry) -> tuple[float, float, float, float]:
    values = [_number([word]) for word in entry.get("kd", [])]
    rgb = values * 3 if len(values) == 1 else values[:3]
    known = GREY[:3] if len(rgb) < 3 or None in values else rgb
    opacity = _number(entry.get("d"))
    if opacity is None:
        transparency = _number(entry.get("tr"))
        opacity = 1.0 if transparency is None else 1.0 - transparency
    red, green, blue, alpha = (float(v) for v in np.clip([*known, opacity], 0.0, 1.0))
    return red, green, blue, alpha


def _number(words: list[str] | None) -> float | None:
    """The last of the words (``d -halo 0.5``), None if it is not a number."""
    try:
        value = float(words[-1]) if words else np.nan
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _without_options(words: Sequence[str]) -> Sequence[str]:
    """The words of ``map_Kd`` without its options, such as ``-s 1 1 1`` and ``-clamp on``."""
    position = 0
    while position < len(words) - 1 and (
        words[position].startswith("-")
        or (position and (_number([words[position]]) is not None or words[position] in _SWITCHES))
    ):
        position += 1
    return words[position:]


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
        folder = beside.parent
        found = find_file(folder, name) or find_file(folder, PurePosixPath(name).name)
        path = folder / name if found is None else found.resolve()
        if path in self._known:
            return self._known[path]
        self._known[path] = None
        if found is None:
            logger.warning("%s: the texture %s is missing; drawn grey", beside, brief(name))
            return None
        keep(found)
        with _left_out(beside, name), open_photo(found) as image:
            self._known[path] = self._pixels(image)
        return self._known[path]

    def decode(self, data: bytes, *, within: Path, name: str) -> Texture | None:
        """Decode a picture that is a part of a file, (h, w, 3 or 4) uint8."""
        if name not in self._known:
            file, self._known[name] = io.BytesIO(data), None
            with _left_out(within, name), open_picture(file, len(data), where=str(within)) as image:
                self._known[name] = self._pixels(image)
        return self._known[name]

    def _pixels(self, image: Image) -> Texture:
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
