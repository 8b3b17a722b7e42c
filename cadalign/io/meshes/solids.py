"""STL and OFF files."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from pathlib import Path

import numpy as np

from cadalign.arrays import parse_numbers
from cadalign.errors import DataError
from cadalign.geometry.mesh import Mesh, fan_triangles
from cadalign.io.files import damaged, read_bytes, require_count

_STL_HEADER = 84
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_STL_CORNER = re.compile(rb"\bvertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)


def read_stl(path: Path) -> Mesh:
    """Read an STL file, text or binary; each face has vertices of its own."""
    data = read_bytes(path)
    found = _STL_CORNER.findall(data) if data.lstrip()[:5].lower() == b"solid" else []
    if found:
        if len(found) % 3 or b"endsolid" not in data[-1000:].lower():
            raise damaged("the text ends before 'endsolid'", path)
        corners = parse_numbers(b" ".join(found), 3 * len(found)).reshape(-1, 3, 3)
    else:
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
    found = re.match(rb"(?:C|N|ST)*OFF(.*)", rows[0][0]) if rows else None
    if found is None:
        raise DataError("not an OFF file", where=str(path), fix="does it begin with 'OFF'?")
    # Some files have the counts in the first line, even without a blank before them.
    counts = [each for each in (found[1], *rows[0][1:]) if each]
    if not counts:
        counts, rows = rows[1], rows[1:]
    vertices, faces = int(counts[0]), int(counts[1])
    points, polygons = rows[1 : 1 + vertices], rows[1 + vertices :]
    require_count("vertices", vertices, len(points), 0, path)
    require_count("faces", faces, len(polygons), 0, path)
    sizes = np.array([int(row[0]) for row in polygons[:faces]], dtype=np.int64)
    if not faces or sizes.min() < 3:
        raise damaged("there is no face, or one of fewer than 3 corners", path)
    corners = b" ".join(b" ".join(row[1 : 1 + int(row[0])]) for row in polygons[:faces])
    triangles, polygon = fan_triangles(sizes)
    return Mesh(
        parse_numbers(b" ".join(b" ".join(row[:3]) for row in points), 3 * vertices).reshape(-1, 3),
        parse_numbers(corners, int(sizes.sum()), np.int64)[triangles],
        polygon=polygon,
        source=str(path),
    )
