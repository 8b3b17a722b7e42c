"""The materials of OBJ files: MTL libraries and the textures they name."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from cadalign.errors import DataError, brief, quote
from cadalign.geometry.mesh import GREY, Material
from cadalign.io.files import read_text
from cadalign.io.meshes.textures import Textures, find_file

logger = logging.getLogger("cadalign")

_Entry = dict[str, list[str]]

WHITE = (1.0, 1.0, 1.0, 1.0)
# How many values follow each option of map_Kd, after "The MTL file format", Wavefront 1995.
_MAP_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-texres": 1, "-imfchan": 1, "-type": 1,
    "-bm": 1, "-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3,
}  # fmt: skip


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


def _paths(obj_path: Path, library: str) -> list[Path]:
    """The files that an ``mtllib`` line names: one with blanks in its name, or several."""
    whole = find_file(obj_path.parent, library)
    if whole is not None:
        return [whole]
    paths = []
    for word in library.split():
        path = find_file(obj_path.parent, word)
        if path is None:
            logger.warning("%s: no material library %s beside it", obj_path, brief(word))
        else:
            paths.append(path)
    return paths


def _parse_library(path: Path) -> dict[str, _Entry]:
    """The materials of a library by name: of each, the words that follow its keywords."""
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
    position = 0
    while position < len(words) - 1 and words[position].lower() in _MAP_OPTIONS:
        option = words[position].lower()
        position += 1
        for value in words[position : position + _MAP_OPTIONS[option]]:
            # -o, -s and -t may leave their second and third value out.
            if option in ("-o", "-s", "-t") and _number([value]) is None:
                break
            position += 1
    return words[position:]
