"""STL and OFF files."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from itertools import chain
from pathlib import Path

import numpy as np

from cadalign.arrays import parse_numbers
from cadalign.errors import DataError, brief
from cadalign.geometry.mesh import Mesh, fan_triangles
from cadalign.io.files import damaged, read_bytes, require_count

_STL_HEADER = 84
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_STL_FACET = re.compile(rb"\bfacet\s+normal\b", re.IGNORECASE)
_OFF_WORD = re.compile(rb"(?:ST)?C?N?(4?n?)OFF(.*)", re.IGNORECASE)
_STL_CORNER = re.compile(rb"\bvertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)


def read_stl(path: Path) -> Mesh:
    """Read an STL file, text or binary; each face has vertices of its own."""
    data = read_bytes(path)
    found = _STL_CORNER.findall(data) if data.lstrip()[:5].lower() == b"solid" else []
    if found:
        announced = len(_STL_FACET.findall(data))
        require_count("faces", announced, len(found) // 3, 0, path)
        end = data.lower().rfind(b"endsolid")
        if end < 0 or len(found) != 3 * announced:
            raise damaged(f"the text ends before 'endsolid', after {announced} faces", path)
        behind = data[end:].partition(b"\n")[2].strip()
        require_count("faces", announced, announced, len(behind), path)
        corners = parse_numbers(b" ".join(found), 3 * len(found)).reshape(-1, 3, 3)
    else:
        if len(data) < _STL_HEADER:
            raise damaged(f"{len(data)} bytes, but the header alone has {_STL_HEADER}", path)
        announced = int.from_bytes(data[80:_STL_HEADER], "little")
        if not announced:
            raise DataError("the file has no faces", where=str(path), fix="is it whole?")
        size = announced * _STL_FACE.itemsize
        there = (len(data) - _STL_HEADER) // _STL_FACE.itemsize
        require_count("faces", announced, there, len(data) - _STL_HEADER - size, path)
        corners = np.frombuffer(data, _STL_FACE, announced, _STL_HEADER)["corners"]
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3).astype(np.float64), faces, source=str(path))


def read_off(path: Path) -> Mesh:
    """Read an OFF file; colours of its vertices and faces are not read."""
    data = read_bytes(path).removeprefix(BOM_UTF8)
    rows = [line.partition(b"#")[0].split() for line in data.splitlines()]
    rows = [row for row in rows if row]
    found = _OFF_WORD.fullmatch(rows[0][0]) if rows else None
    if found is None:
        raise DataError("not an OFF file", where=str(path), fix="does it begin with 'OFF'?")
    if found[1] or rows[0][1:2] == [b"BINARY"]:
        kind = "of more than three dimensions" if found[1] else "binary"
        fix = "save it as text of three dimensions"
        raise DataError(f"an OFF file that is {kind} is not read", where=str(path), fix=fix)
    # Some files have the counts in the first line, even without a blank before them.
    counts = [each for each in (found[2], *rows[0][1:]) if each]
    if not counts:
        counts, rows = rows[1], rows[1:]
    vertices, faces = int(counts[0]), int(counts[1])
    if min(vertices, faces) < 1:
        raise damaged(f"the header announces {vertices} vertices and {faces} faces", path)
    lines, last = rows[1:], vertices + faces
    surplus = sum(map(len, chain(*lines[last:])))
    require_count("vertices", vertices, len(lines), 0, path)
    require_count("faces", faces, len(lines) - vertices, surplus, path)
    points, polygons = lines[:vertices], lines[vertices:last]
    for number, row in enumerate(polygons):
        if not row[0].isdigit() or len(row) <= int(row[0]):
            what = f"face {number} is {brief(b' '.join(row).decode('ascii', 'replace'))!r}"
            raise damaged(f"{what}, behind the {vertices} vertices announced", path)
    sizes = np.array([int(row[0]) for row in polygons], dtype=np.int64)
    if sizes.min() < 3:
        raise damaged(f"face {int(sizes.argmin())} has {sizes.min()} corners", path)
    corners = b" ".join(b" ".join(row[1 : 1 + int(row[0])]) for row in polygons)
    triangles, polygon = fan_triangles(sizes)
    return Mesh(
        parse_numbers(b" ".join(b" ".join(row[:3]) for row in points), 3 * vertices).reshape(-1, 3),
        parse_numbers(corners, int(sizes.sum()), np.int64)[triangles],
        polygon=polygon,
        source=str(path),
    )
