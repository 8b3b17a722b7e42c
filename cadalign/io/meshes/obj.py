"""Wavefront OBJ files, read with their faces in file order.

Keypoint annotations name faces by the number of their ``f`` line. Readers that group faces by
material lose that order, so this one keeps it. The format: Wavefront's "Object Files (.obj)",
appendix B1 of the Advanced Visualizer manual.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray, parse_numbers
from cadalign.errors import DataError
from cadalign.geometry.mesh import Material, Mesh
from cadalign.io.files import damaged, read_bytes
from cadalign.io.meshes.materials import WHITE, load_materials

_DIGITS = b"0123456789+-"
_MAX_VALUES = 16  # of a vertex; the format has at most 7
# Assimp, which wrote ShapeNetCore.v2, says in a comment how many faces, lines and points follow.
_ASSIMP_MARK = b"Open Asset Import Library"
_ASSIMP_COUNT = re.compile(rb"# Mesh '.*' with (\d+) faces")


@dataclass
class _Statements:
    """The statements of a file, sorted by kind and not yet turned into numbers."""

    vertices: list[bytes] = field(default_factory=list)
    texture_coordinates: list[bytes] = field(default_factory=list)
    faces: list[bytes] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    # (first face, vertices so far, texture coordinates so far): what negative indices count from.
    counts_at: list[tuple[int, int, int]] = field(default_factory=list)
    # (first face, material name)
    materials_at: list[tuple[int, str]] = field(default_factory=list)
    other_elements: int = 0
    declared_elements: int = 0


def read_obj(path: Path) -> Mesh:
    """Read an OBJ file; `cadalign.load_mesh` is the public way to it.

    Polygons are cut into fans of triangles, and `Mesh.polygon` holds the number of the ``f`` line
    that a triangle comes from. Lines and points (``l``, ``p``) have no number. Normals, groups,
    curves and surfaces are not read.
    """
    statements = _sort_statements(read_bytes(path), path)
    _require_complete(statements, path)
    try:
        vertices, colors = _parse_vertices(statements.vertices)
        texture_coordinates = _parse_rows(statements.texture_coordinates)
        corners, sizes = _parse_faces(statements.faces)
    except (ValueError, OverflowError):
        raise _first_malformed(path) from None
    line_of_corner = np.repeat(np.arange(len(sizes)), sizes)
    starts = np.array(statements.counts_at, dtype=np.int64)
    seen = starts[np.searchsorted(starts[:, 0], line_of_corner, side="right") - 1, 1:]

    def absolute(kind: int, chosen: BoolArray | slice, count: int) -> IntArray:
        """Indices from 0; negative ones count back from the face. Kind 0 is that of vertices."""
        indices, lines = corners[chosen, kind], line_of_corner[chosen]
        rows = np.where(indices < 0, seen[chosen, kind] + indices, indices - 1)
        wrong = np.flatnonzero((rows < 0) | (rows >= count))
        if len(wrong):
            named = f"{('vertex', 'texture coordinate')[kind]} {indices[wrong[0]]}"
            face = f"face {lines[wrong[0]]} (counted from 0)"
            raise damaged(f"{face} names {named}, but there are {count}", path)
        return np.asarray(rows)

    vertex_rows = absolute(0, slice(None), len(vertices))
    corner_uv, has_uv = np.zeros((len(corners), 2)), corners[:, 1] != 0
    if has_uv.any():
        width = min(texture_coordinates.shape[1], 2)
        rows = absolute(1, has_uv, len(texture_coordinates))
        corner_uv[has_uv, :width] = texture_coordinates[rows, :width]
    triangles, polygon = fan_triangles(sizes)
    materials, face_material = _assign_materials(statements, path, polygon, colors is not None)
    return Mesh(
        vertices=vertices,
        faces=vertex_rows[triangles],
        polygon=polygon,
        vertex_colors=colors,
        # (0, 0) where a corner names no texture coordinate.
        corner_uv=corner_uv[triangles] if has_uv.any() else None,
        materials=materials,
        face_material=face_material,
        source=str(path),
    )


def fan_triangles(sizes: IntArray) -> tuple[IntArray, IntArray]:
    """Cut polygons, whose corners are listed one after the other, into fans of triangles.

    From the polygons' numbers of corners (p,), at least 3, follow the triangles (m, 3) as positions
    in the list of all corners, and the polygons (m,), ascending, that they were cut from.
    """
    first_corner = np.cumsum(sizes) - sizes
    counts = sizes - 2
    polygon = np.repeat(np.arange(len(sizes)), counts)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = first_corner[polygon]
    return np.stack([first, first + step + 1, first + step + 2], axis=1), polygon


def _sort_statements(data: bytes, path: Path) -> _Statements:
    found = _Statements()
    # Nearly all lines are these three.
    vertices, texture_coordinates, faces = found.vertices, found.texture_coordinates, found.faces
    by_assimp = False
    counted = (-1, -1)
    for number, line in _logical_lines(data):
        key, _, body = line.partition(b" ")
        if key == b"f":
            counts = (len(vertices), len(texture_coordinates))
            if counts != counted:
                found.counts_at.append((len(faces), *counts))
                counted = counts
            faces.append(body)
        elif key == b"v":
            vertices.append(body)
        elif key == b"vt":
            texture_coordinates.append(body)
        elif key in (b"vn", b""):
            continue
        elif key in (b"l", b"p"):
            found.other_elements += 1
        elif key == b"usemtl":
            found.materials_at.append((len(found.faces), _text(body)))
        elif key == b"mtllib":
            found.libraries.append(_text(body))
        elif key.startswith(b"#"):
            by_assimp = by_assimp or _ASSIMP_MARK in line
            count = _ASSIMP_COUNT.match(line) if by_assimp else None
            found.declared_elements += int(count[1]) if count else 0
        elif b"\0" in line:
            what = "holds binary data, not the text of an OBJ file"
            raise damaged(what, f"{path}, line {number}")
    return found


def _logical_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The lines with their numbers, stripped; a line that ends in a backslash goes on."""
    # A tab may separate the keyword too.
    lines = data.removeprefix(BOM_UTF8).replace(b"\t", b" ").split(b"\n")
    parts: list[bytes] = []
    for number, line in enumerate(map(bytes.strip, lines), start=1):
        if line[-1:] == b"\\":
            parts.append(line[:-1])
        elif parts:
            yield number, b" ".join([*parts, line])
            parts = []
        else:
            yield number, line
    if parts:
        yield len(lines), b" ".join(parts)


def _require_complete(statements: _Statements, path: Path) -> None:
    if not statements.faces:
        raise DataError(
            f"no faces; {len(statements.vertices)} vertices and {statements.other_elements} lines "
            "and points were found",
            where=str(path),
            fix="is it an OBJ file, and whole?",
        )
    if not statements.vertices:
        raise damaged(f"{len(statements.faces)} faces, but no vertices", path)
    found = len(statements.faces) + statements.other_elements
    if found < statements.declared_elements:
        announced = f"its comments announce {statements.declared_elements} faces and lines"
        raise damaged(f"{announced}, but only {found} are there", path)


def _lengths(bodies: list[bytes], text: bytes) -> IntArray:
    """Numbers of words of the statements (n,), whose joined text is ``text``."""
    if text != text.strip() or b"  " in text or len(text.translate(None, b"\r\v\f")) < len(text):
        return np.array([len(body.split()) for body in bodies], dtype=np.int64)
    return np.array([body.count(b" ") for body in bodies], dtype=np.int64) + 1


def _joined(bodies: list[bytes]) -> tuple[list[bytes], bytes]:
    """Statements without comments at their ends, and the text of all."""
    text = b" ".join(bodies)
    if b"#" not in text:
        return bodies, text
    bodies = [body.partition(b"#")[0].rstrip() for body in bodies]
    return bodies, b" ".join(bodies)


def _parse_rows(bodies: list[bytes], *, least: int = 1, padding: float = 0.0) -> FloatArray:
    """The numbers of statements that may differ in length, padded; (n, width) float."""
    bodies, text = _joined(bodies)
    lengths = _lengths(bodies, text)
    if (lengths < least).any():
        raise ValueError("too few numbers in a line")
    values = parse_numbers(text, int(lengths.sum()))
    width = int(lengths.max(initial=0))
    if width > _MAX_VALUES:
        raise ValueError("too many numbers in a line")
    if (lengths == width).all():
        return np.asarray(values.reshape(len(bodies), width))
    rows = np.full((len(bodies), width), padding)
    rows[np.arange(width) < lengths[:, None]] = values
    return rows


def _parse_vertices(bodies: list[bytes]) -> tuple[FloatArray, FloatArray | None]:
    """Positions (n, 3), and colours (n, 4) if there are any: ``x y z [w] [r g b]``."""
    rows = _parse_rows(bodies, least=3, padding=1.0)  # white, where some vertices have a colour
    width = rows.shape[1]
    if width < 6:
        return np.ascontiguousarray(rows[:, :3]), None
    colors = np.ones((len(rows), 4))
    colors[:, :3] = rows[:, 3:6] if width == 6 else rows[:, 4:7]
    if colors.max() > 1:
        colors[:, :3] /= 255
    return np.ascontiguousarray(rows[:, :3]), np.clip(colors, 0, 1)


def _parse_faces(bodies: list[bytes]) -> tuple[IntArray, IntArray]:
    """Corners (c, 2) as (vertex, texture coordinate or 0), as in the file, and faces' sizes."""
    bodies, text = _joined(bodies)
    sizes = _lengths(bodies, text)
    if sizes.min() < 3:
        raise ValueError("a face has fewer than 3 corners")
    total = int(sizes.sum())
    # What stays when digits and signs go is the form of each corner: "", "/" or "//".
    forms = set(text.translate(None, _DIGITS).split())
    if b"/ " in text or text.endswith(b"/"):  # 1/ for a corner without more: read one by one
        forms = {b""}
    doubled = text.count(b"//")
    corners = np.zeros((total, 2), dtype=np.int64)
    if not forms:
        corners[:, 0] = parse_numbers(text, total, np.int64)
    elif forms == {b"/"} and text.count(b"/") == total:
        corners[:] = parse_numbers(text.replace(b"/", b" "), 2 * total, np.int64).reshape(total, 2)
    elif forms == {b"//"} and doubled == total:
        corners[:, 0] = parse_numbers(text.replace(b"//", b" "), 2 * total, np.int64)[::2]
    elif forms == {b"//"} and not doubled and text.count(b"/") == 2 * total:
        values = parse_numbers(text.replace(b"/", b" "), 3 * total, np.int64)
        corners[:] = values.reshape(total, 3)[:, :2]
    else:
        corners[:] = [_parse_corner(corner) for corner in text.split()]
    return corners, sizes


def _parse_corner(corner: bytes) -> tuple[int, int]:
    """One corner of a face in any of the four forms, slowly."""
    parts = corner.split(b"/")
    if len(parts) > 3:
        raise ValueError(f"{corner!r} is not a corner")
    if len(parts) == 3 and parts[2]:
        int(parts[2])
    return int(parts[0]), int(parts[1]) if len(parts) > 1 and parts[1] else 0


def _assign_materials(
    statements: _Statements, path: Path, polygon: IntArray, colored: bool
) -> tuple[tuple[Material, ...], npt.NDArray[np.int64]]:
    blocks = [(0, ""), *statements.materials_at]
    starts = np.array([start for start, _ in blocks])
    # Of blocks that start at the same face only the last one colours it: the others are empty.
    block_of_triangle = np.searchsorted(starts, polygon, side="right") - 1
    used, index = np.unique(block_of_triangle, return_inverse=True)
    names = list(dict.fromkeys(blocks[block][1] for block in used))
    number_of = {name: number for number, name in enumerate(names)}
    number = np.array([number_of[blocks[block][1]] for block in used])
    known = load_materials(path, statements.libraries, [name for name in names if name])
    plain = Material(color=WHITE) if colored else Material()
    return tuple(known.get(name, plain) for name in names), number[index]


def _first_malformed(path: Path) -> DataError:
    """Read the file again, slowly, to say which line of it is wrong."""
    for number, line in _logical_lines(read_bytes(path)):
        key, _, body = line.partition(b" ")
        try:
            if key == b"v":
                _parse_vertices([body])
            elif key == b"vt":
                _parse_rows([body])
            elif key == b"f":
                _parse_faces([body])
        except (ValueError, OverflowError):
            shown = line[:60].decode("ascii", errors="replace")
            return damaged(f"cannot read {shown!r}", f"{path}, line {number}")
    return damaged("cannot be read as an OBJ file", path)


def _text(body: bytes) -> str:
    return body.decode("utf-8", errors="replace").strip()
