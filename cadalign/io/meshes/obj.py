"""Wavefront OBJ files, read with their faces in file order.

Keypoint annotations name faces by the number of their ``f`` line. Readers that group faces by
material lose that order, so this one keeps it. The format: Wavefront's "Object Files (.obj)",
appendix B1 of the Advanced Visualizer manual.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray, parse_numbers
from cadalign.errors import DataError
from cadalign.geometry.mesh import Material, Mesh
from cadalign.io.files import damaged
from cadalign.io.meshes.materials import WHITE, load_materials

_DIGITS = b"0123456789+-"
_MAX_VALUES = 16  # of a vertex; the format has at most 7
_BLANK, _NEWLINE = b" \n"
_BLANKS = bytes.maketrans(b"\t\r", b"  ")
_Rows = tuple[bytes, IntArray]
"""Words of some lines, one after the other, and how many each line has."""


def read_obj(data: bytes, path: Path) -> Mesh:
    """Read the content of an OBJ file; `cadalign.load_mesh` is the public way to it.

    Polygons are cut into fans of triangles, and `Mesh.polygon` holds the number of the ``f`` line
    that a triangle comes from. Lines and points (``l``, ``p``) have no number. Normals, groups,
    curves and surfaces are not read.
    """
    data = _tidied(data)
    codes = np.frombuffer(data, np.uint8)
    ends = np.flatnonzero(codes == _NEWLINE)
    starts = np.append(0, ends[:-1] + 1)
    found = {key: _begin_with(key, codes, starts) for key in (b"v", b"vt", b"f", b"vn")}
    faces = np.flatnonzero(found[b"f"])
    libraries: list[str] = []
    numbers, changes = {"": 0}, [(0, 0)]  # materials; the line from which on faces have which
    others = ~np.logical_or.reduce([*found.values()]) & (ends > starts)
    for number in np.flatnonzero(others).tolist():
        line = data[starts[number] : ends[number]]
        key, _, body = line.partition(b" ")
        if key == b"usemtl":
            changes.append((number, numbers.setdefault(_text(body), len(numbers))))
        elif key == b"mtllib":
            libraries.append(_text(body))
        elif b"\0" in line:
            raise damaged("holds binary data, not the text of an OBJ file", f"line {number + 1}")
    if not len(faces):
        what = f"no faces; {found[b'v'].sum()} vertices were found"
        raise DataError(what, fix="is it an OBJ file, and whole?")
    if not found[b"v"].any():
        raise damaged(f"{len(faces)} faces, but no vertices")
    lengths = ends + 1 - starts
    rows = {key: _words(key, codes[np.repeat(found[key], lengths)]) for key in (b"v", b"vt", b"f")}
    try:
        vertices, colors = _parse_vertices(rows[b"v"])
        coordinates = _parse_rows(rows[b"vt"])
        corners, sizes = _parse_faces(rows[b"f"])
    except (ValueError, OverflowError):
        raise _first_malformed(data) from None
    # Vertices and texture coordinates before each face: negative indices count back from there.
    before = np.stack([np.cumsum(found[key])[faces] for key in (b"v", b"vt")], axis=1)
    first, materials = np.array(changes).T
    looks = materials[np.searchsorted(first, faces, side="right") - 1]
    seen = np.repeat(before, sizes, axis=0)
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


def _tidied(data: bytes) -> bytes:
    """The text with blanks for tabs, none at the begin of a line, and a newline at its end.

    A line that ends in a backslash goes on; empty lines behind it keep the count.
    """
    data = data.translate(_BLANKS) + b"\n"  # a tab may separate the keyword too
    if b"\\" not in data and b"\n " not in data and data[:1] != b" ":
        return data
    lines: list[bytes] = []
    parts: list[bytes] = []
    for line in map(bytes.strip, data.split(b"\n")):
        if line[-1:] == b"\\":
            parts.append(line[:-1])
        else:
            lines += [b" ".join([*parts, line]), *[b""] * len(parts)]
            parts = []
    return b"\n".join([*lines, *parts, b""])


def _begin_with(key: bytes, codes: npt.NDArray[np.uint8], starts: IntArray) -> BoolArray:
    """The lines (n,) that have a keyword."""
    last = len(codes) - 1
    found = codes[np.minimum(starts + len(key), last)] <= _BLANK
    for place, code in enumerate(key):
        found &= codes[np.minimum(starts + place, last)] == code
    return found


def _words(key: bytes, codes: npt.NDArray[np.uint8]) -> _Rows:
    """The words behind the keyword of lines that have it."""
    starts = np.append(0, np.flatnonzero(codes[:-1] == _NEWLINE) + 1)[: len(codes)]
    for place in range(len(key)):
        codes[starts + place] = _BLANK
    text = codes.tobytes()
    if b"#" in text:
        text = re.sub(rb"#.*", b"", text)
        codes = np.frombuffer(text, np.uint8)
    is_blank = codes <= _BLANK
    ends = np.flatnonzero(is_blank[1:] & ~is_blank[:-1]) + 1
    before = np.searchsorted(ends, np.flatnonzero(codes == _NEWLINE), side="right")
    return text.replace(b"\n", b" "), np.diff(before, prepend=0)


def _parse_rows(rows: _Rows, *, least: int = 1, padding: float = 0.0) -> FloatArray:
    """The numbers of statements that may differ in length, padded; (n, width) float."""
    text, lengths = rows
    width = int(lengths.max(initial=0))
    if (lengths < least).any() or width > _MAX_VALUES:
        raise ValueError("too few or too many numbers in a line")
    values = parse_numbers(text, int(lengths.sum()))
    found = np.full((len(lengths), width), padding)
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
    text, sizes = rows
    if sizes.min() < 3:
        raise ValueError("a face has fewer than 3 corners")
    total, text = int(sizes.sum()), text.replace(b"//", b"/0/")
    # What stays when digits and signs go is the form of each corner: "", "/" or "//".
    forms = set(text.translate(None, _DIGITS).split())
    width = text.count(b"/") // total + 1
    is_even = forms == ({b"/" * (width - 1)} if width > 1 else set())
    corners = np.zeros((total, 2), dtype=np.int64)
    if is_even and width <= 3 and b"/ " not in text:
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
    for number, line in enumerate(data.split(b"\n"), start=1):
        key = line.partition(b" ")[0]
        try:
            if key in parsers:
                parsers[key](_words(key, np.frombuffer(bytearray(line + b"\n"), np.uint8)))
        except (ValueError, OverflowError):
            shown = line[:60].decode("ascii", errors="replace")
            return damaged(f"cannot read {shown!r}", f"line {number}")
    return damaged("cannot be read as an OBJ file")


def _text(body: bytes) -> str:
    return body.decode("utf-8", errors="replace").strip()
