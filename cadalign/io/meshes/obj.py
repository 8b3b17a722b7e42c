"""Wavefront OBJ files, read with their faces in file order.

Keypoint annotations name faces by the number of their ``f`` line. Readers that group faces by
material lose that order, so this one keeps it. The format: Wavefront's "Object Files (.obj)",
appendix B1 of the Advanced Visualizer manual.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DataError
from cadalign.geometry.mesh import Material, Mesh
from cadalign.io.files import damaged
from cadalign.io.meshes.materials import WHITE, load_materials

_NO_COLOR = (np.nan, np.nan, np.nan)


def read_obj(data: bytes, path: Path) -> Mesh:
    """Read the content of an OBJ file; `cadalign.load_mesh` is the public way to it.

    Polygons are cut into fans of triangles, and `Mesh.polygon` holds the number of the ``f`` line
    that a triangle comes from. Lines and points (``l``, ``p``) have no number. Normals, groups,
    curves and surfaces are not read.
    """
    vertices, colors = list[list[float]](), list[object]()
    coordinates, corners = list[list[float]](), list[tuple[int, int]]()
    sizes, looks, before = list[int](), list[int](), list[tuple[int, int]]()
    libraries, numbers, look = list[str](), {"": 0}, 0  # numbers of materials, by name
    for number, line in _lines(data):
        key, _, body = line.partition(b" ")
        words = body.partition(b"#")[0].split()
        try:
            if key == b"v":
                vertices.append([*map(float, words[:3])])
                colors.append([*map(float, words[-3:])] if words[5:] else _NO_COLOR)
                if len(words) < 3:
                    raise ValueError("a vertex has fewer than 3 coordinates")
            elif key == b"vt":
                coordinates.append([float(words[0]), float(words[1]) if words[1:] else 0.0])
            elif key == b"f":
                if len(words) < 3:
                    raise ValueError("a face has fewer than 3 corners")
                corners += map(_corner, words)
                sizes.append(len(words))
                looks.append(look)
                # Negative indices count back from here.
                before.append((len(vertices), len(coordinates)))
            elif key == b"usemtl":
                look = numbers.setdefault(_text(body), len(numbers))
            elif key == b"mtllib":
                libraries.append(_text(body))
            elif b"\0" in line:
                raise damaged("holds binary data, not the text of an OBJ file", f"line {number}")
        except (ValueError, IndexError):
            shown = line[:60].decode("ascii", errors="replace")
            raise damaged(f"cannot read {shown!r}", f"line {number}") from None
    if not sizes:
        what = f"no faces; {len(vertices)} vertices were found"
        raise DataError(what, fix="is it an OBJ file, and whole?")
    if not vertices:
        raise damaged(f"{len(sizes)} faces, but no vertices")
    named = np.array(corners, dtype=np.int64)
    indices = np.where(named < 0, np.repeat(before, sizes, axis=0) + named, named - 1)
    has_uv = named[:, 1] != 0
    for kind, name, count, used in (
        (0, "vertex", len(vertices), np.ones_like(has_uv)),
        (1, "texture coordinate", len(coordinates), has_uv),
    ):
        wrong = np.flatnonzero(used & ((indices[:, kind] < 0) | (indices[:, kind] >= count)))
        if len(wrong):
            face = np.repeat(np.arange(len(sizes)), sizes)[wrong[0]]
            what = f"face {face} (counted from 0) names {name} {named[wrong[0], kind]}"
            raise damaged(f"{what}, but there are {count}")
    corner_uv = np.zeros((len(named), 2))  # where a corner names no texture coordinate
    if has_uv.any():
        corner_uv[has_uv] = np.array(coordinates)[indices[has_uv, 1]]
    used, rows_of = np.unique(looks, return_inverse=True)
    names = np.array([*numbers], dtype=object)[used].tolist()
    known = load_materials(path, libraries, [name for name in names if name])
    vertex_colors = _vertex_colors(np.array(colors, dtype=float))
    plain = Material() if vertex_colors is None else Material(color=WHITE)
    return Mesh.from_polygons(
        np.array(vertices),
        indices[:, 0],
        np.array(sizes),
        corner_uv=corner_uv if has_uv.any() else None,
        polygon_material=rows_of.reshape(-1),
        vertex_colors=vertex_colors,
        materials=tuple(known.get(name, plain) for name in names),
        source=str(path),
    )


def _lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers, without blanks at their ends; one that ends in a backslash goes on.

    The keyword is followed by a blank.
    """
    begun = b""
    for number, line in enumerate(data.replace(b"\t", b" ").splitlines(), start=1):
        line = begun + line.strip()
        begun = line[:-1] + b" " if line[-1:] == b"\\" else b""
        if line and not begun:
            yield number, line


@lru_cache(maxsize=2**16)  # each is named by several faces
def _corner(word: bytes) -> tuple[int, int]:
    """A corner of a face as (vertex, texture coordinate or 0): ``v``, ``v/vt``, ``v//vn``, ...."""
    vertex, *others = word.split(b"/")
    values = [int(each or b"0") for each in others]
    if len(values) > 2:
        raise ValueError(f"{word!r} is not a corner")
    return int(vertex), values[0] if values else 0


def _vertex_colors(colors: FloatArray) -> FloatArray | None:
    """Colours (n, 4) of vertices, of ``x y z [w] r g b``, from their rows; NaN where none is."""
    if np.isnan(colors).all():
        return None
    scale = 255.0 if np.nanmax(colors) > 1 else 1.0
    found = np.ones((len(colors), 4))  # white, where only others have a colour
    found[:, :3] = np.nan_to_num(np.clip(colors / scale, 0, 1), nan=1.0)
    return found


def _text(body: bytes) -> str:
    return body.decode("utf-8", errors="replace").strip()
