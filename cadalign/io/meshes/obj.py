"""Wavefront OBJ files, read with their faces in file order.

Keypoint annotations name faces by the number of their ``f`` line. Readers that group faces by
material lose that order, so this one keeps it. The format: Wavefront's "Object Files (.obj)",
appendix B1 of the Advanced Visualizer manual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray, parse_numbers
from cadalign.errors import DataError
from cadalign.geometry.mesh import Material, Mesh
from cadalign.io.files import damaged
from cadalign.io.meshes.materials import WHITE, load_materials

_DIGITS = b"0123456789+-"
_MAX_VALUES = 16  # of a vertex; the format has at most 7
_Rows = list[list[bytes]]


def read_obj(data: bytes, path: Path) -> Mesh:
    """Read the content of an OBJ file; `cadalign.load_mesh` is the public way to it.

    Polygons are cut into fans of triangles, and `Mesh.polygon` holds the number of the ``f`` line
    that a triangle comes from. Lines and points (``l``, ``p``) have no number. Normals, groups,
    curves and surfaces are not read.
    """
    rows: dict[bytes, _Rows] = {b"v": [], b"vt": [], b"f": []}
    # Of each face: vertices and texture coordinates before it, from which negative indices count
    # back, and the number of its material.
    before: list[tuple[int, int, int]] = []
    libraries: list[str] = []
    numbers, material = {"": 0}, 0
    for number, line in _logical_lines(data):
        key, _, body = line.partition(b" ")
        if key in rows:
            if key == b"f":
                before.append((len(rows[b"v"]), len(rows[b"vt"]), material))
            rows[key].append(_words(body))
        elif key == b"usemtl":
            material = numbers.setdefault(_text(body), len(numbers))
        elif key == b"mtllib":
            libraries.append(_text(body))
        elif b"\0" in line:
            raise damaged("holds binary data, not the text of an OBJ file", f"line {number}")
    if not before:
        what = f"no faces; {len(rows[b'v'])} vertices were found"
        raise DataError(what, fix="is it an OBJ file, and whole?")
    if not rows[b"v"]:
        raise damaged(f"{len(before)} faces, but no vertices")
    try:
        vertices, colors = _parse_vertices(rows[b"v"])
        coordinates = _parse_rows(rows[b"vt"])
        corners, sizes = _parse_faces(rows[b"f"])
    except (ValueError, OverflowError):
        raise _first_malformed(data) from None
    counts, looks = np.split(np.array(before), [2], axis=1)
    seen = np.repeat(counts, sizes, axis=0)
    has_uv = corners[:, 1] != 0
    indices = np.where(corners < 0, seen + corners, corners - 1)
    for kind, name, count, used in (
        (0, "vertex", len(vertices), np.ones_like(has_uv)),
        (1, "texture coordinate", len(coordinates), has_uv),
    ):
        wrong = np.flatnonzero(used & ((indices[:, kind] < 0) | (indices[:, kind] >= count)))
        if len(wrong):
            face = np.repeat(np.arange(len(sizes)), sizes)[wrong[0]]
            what = f"face {face} (counted from 0) names {name} {corners[wrong[0], kind]}"
            raise damaged(f"{what}, but there are {count}")
    corner_uv = np.zeros((len(corners), 2))  # where a corner names no texture coordinate
    if has_uv.any():
        width = min(coordinates.shape[1], 2)
        corner_uv[has_uv, :width] = coordinates[indices[has_uv, 1], :width]
    used, rows_of = np.unique(looks, return_inverse=True)
    names = np.array([*numbers], dtype=object)[used].tolist()
    known = load_materials(path, libraries, [name for name in names if name])
    plain = Material(color=WHITE) if colors is not None else Material()
    return Mesh.from_polygons(
        vertices,
        indices[:, 0],
        sizes,
        corner_uv=corner_uv if has_uv.any() else None,
        polygon_material=rows_of.reshape(-1),
        vertex_colors=colors,
        materials=tuple(known.get(name, plain) for name in names),
        source=str(path),
    )


def _logical_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The lines with their numbers, stripped; a line that ends in a backslash goes on."""
    # A tab may separate the keyword too.
    lines = data.replace(b"\t", b" ").split(b"\n")
    if b"\\" not in data:  # as in most files: a loop takes longer
        yield from enumerate(map(bytes.strip, lines), start=1)
        return
    parts: list[bytes] = []
    for number, line in enumerate(map(bytes.strip, lines), start=1):
        if line[-1:] == b"\\" and number < len(lines):
            parts.append(line[:-1])
        else:
            yield number, b" ".join([*parts, line]) if parts else line
            parts = []


def _words(body: bytes) -> list[bytes]:
    return (body.partition(b"#")[0] if b"#" in body else body).split()


def _parse_rows(rows: _Rows, *, least: int = 1, padding: float = 0.0) -> FloatArray:
    """The numbers of statements that may differ in length, padded; (n, width) float."""
    lengths = np.fromiter(map(len, rows), np.int64, len(rows))
    width = int(lengths.max(initial=0))
    if (lengths < least).any() or width > _MAX_VALUES:
        raise ValueError("too few or too many numbers in a line")
    values = parse_numbers(b" ".join(chain.from_iterable(rows)), int(lengths.sum()))
    found = np.full((len(rows), width), padding)
    found[np.arange(width) < lengths[:, None]] = values
    return found


def _parse_vertices(rows: _Rows) -> tuple[FloatArray, FloatArray | None]:
    """Positions (n, 3), and colours (n, 4) if there are any: ``x y z [w] [r g b]``."""
    values = _parse_rows(rows, least=3, padding=1.0)  # white, where some vertices have a colour
    width = values.shape[1]
    if width < 6:
        return values[:, :3], None
    colors = np.ones((len(values), 4))
    colors[:, :3] = values[:, 3:6] if width == 6 else values[:, 4:7]
    if colors.max() > 1:
        colors[:, :3] /= 255
    return values[:, :3], np.clip(colors, 0, 1)


def _parse_faces(rows: _Rows) -> tuple[IntArray, IntArray]:
    """Corners (c, 2) as (vertex, texture coordinate or 0), as in the file, and faces' sizes."""
    sizes = np.fromiter(map(len, rows), np.int64, len(rows))
    if sizes.min() < 3:
        raise ValueError("a face has fewer than 3 corners")
    total, text = int(sizes.sum()), b" ".join(chain.from_iterable(rows)).replace(b"//", b"/0/")
    # What stays when digits and signs go is the form of each corner: "", "/" or "//".
    forms = set(text.translate(None, _DIGITS).split())
    width = text.count(b"/") // total + 1
    is_even = forms == ({b"/" * (width - 1)} if width > 1 else set())
    corners = np.zeros((total, 2), dtype=np.int64)
    if is_even and width <= 3 and b"/ " not in text and not text.endswith(b"/"):
        values = parse_numbers(text.replace(b"/", b" "), width * total, np.int64)
        corners[:, : min(width, 2)] = values.reshape(total, width)[:, :2]
    else:
        corners[:] = [_parse_corner(corner) for corner in text.split()]
    return corners, sizes


def _parse_corner(corner: bytes) -> tuple[int, int]:
    """One corner of a face in any of the four forms, slowly."""
    vertex, *others = corner.split(b"/")
    values = [int(each or b"0") for each in others]
    if len(values) > 2:
        raise ValueError(f"{corner!r} is not a corner")
    return int(vertex), values[0] if values else 0


def _first_malformed(data: bytes) -> DataError:
    """Read the statements again, one by one, to name the line that is wrong."""
    parsers: dict[bytes, Callable[[_Rows], object]] = {
        b"v": _parse_vertices,
        b"vt": _parse_rows,
        b"f": _parse_faces,
    }
    for number, line in _logical_lines(data):
        key, _, body = line.partition(b" ")
        try:
            parsers.get(key, len)([_words(body)])
        except (ValueError, OverflowError):
            shown = line[:60].decode("ascii", errors="replace")
            return damaged(f"cannot read {shown!r}", f"line {number}")
    return damaged("cannot be read as an OBJ file")


def _text(body: bytes) -> str:
    return body.decode("utf-8", errors="replace").strip()
