"""Read OBJ, PLY, STL and OFF files, with faces in file order.

Keypoint annotations number faces in file order. Readers that group faces by material lose this
order. trimesh also moves quads behind triangles in text PLY and OFF files, and does not read binary
PLY files that mix polygon sizes.

References: Wavefront, "Object Files (.obj)", appendix B1 of the Advanced Visualizer manual; Greg
Turk, "The PLY polygon file format", 1994.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import parse_numbers
from cadalign.errors import DataError, brief
from cadalign.geometry.mesh import GREY, Material, Mesh
from cadalign.io.files import damage_error, require_count
from cadalign.io.meshes.materials import WHITE, load_materials, vertex_colors

_NO_COLOR = (np.nan, np.nan, np.nan)


def read_obj(data: bytes, path: Path) -> Mesh:
    """Read the content of an OBJ file; users call `cadalign.load_mesh`.

    Polygons become fans of triangles; `Mesh.polygon` holds the number of each triangle's ``f``
    line. Lines and points (``l``, ``p``) are not counted. Normals, groups, curves and surfaces are
    ignored.
    """
    vertices = list[list[float]]()  # with their colours
    coordinates = [[0.0, 0.0]]  # the first is for corners without texture coordinates
    corners, before = list[tuple[int, int]](), list[tuple[int, int]]()
    sizes, looks = list[int](), list[int]()
    libraries, numbers, look = list[str](), {"": 0}, 0  # numbers of materials, by name
    text, number = data.replace(b"\t", b" ").replace(b"\r\n", b"\n"), 0
    # A backslash at the end continues a line; "\v" keeps count of them, and is a blank.
    for line in text.replace(b"\\\n", b" \v").splitlines():
        number += 1 + line.count(b"\v")
        key, _, body = line.strip().partition(b" ")
        words = body.partition(b"#")[0].split()
        try:
            if key == b"v":
                color = map(float, words[-3:]) if words[5:] else _NO_COLOR
                vertices.append([*map(float, words[:3]), *color])
                if len(words) < 3:
                    raise ValueError("a vertex has fewer than 3 coordinates")
            elif key == b"vt":
                coordinates.append([float(words[0]), float(words[1]) if words[1:] else 0.0])
            elif key == b"f":
                if len(words) < 3:
                    raise ValueError("a face has fewer than 3 corners")
                corners += map(_parse_corner, words)
                sizes.append(len(words))
                looks.append(look)
                # Negative indices count back from the current line.
                before.append((len(vertices) + 1, len(coordinates)))
            elif key == b"usemtl":
                look = numbers.setdefault(body.decode(errors="replace").strip(), len(numbers))
            elif key == b"mtllib":
                libraries.append(body.decode(errors="replace").strip())
            elif b"\0" in line:
                raise damage_error(
                    "holds binary data, not the text of an OBJ file", f"line {number}"
                )
        except (ValueError, IndexError):
            shown = line.strip()[:60].decode("ascii", errors="replace")
            raise damage_error(f"cannot read {shown!r}", f"line {number}") from None
    if not sizes:
        what = f"the file has {len(vertices)} vertices, but no faces"
        raise DataError(what, fix="is it a complete OBJ file?")
    if not vertices:
        raise damage_error(f"the file has {len(sizes)} faces, but no vertices")
    named = np.array(corners)
    indices = np.where(named < 0, np.repeat(before, sizes, axis=0) + named, named)
    counts = len(vertices), len(coordinates) - 1
    wrong = np.flatnonzero(((indices < (1, 0)) | (indices > counts)).any(axis=1))
    if len(wrong):
        face = np.repeat(np.arange(len(sizes)), sizes)[wrong[0]]
        what = f"face {face} (counted from 0) names {'/'.join(map(str, named[wrong[0]]))}, but"
        raise damage_error(f"{what} there are {counts[0]} vertices, {counts[1]} coordinates")
    used, rows_of = np.unique(looks, return_inverse=True)
    names = np.array([*numbers], dtype=object)[used].tolist()
    known = load_materials(path, libraries, [name for name in names if name])
    rows = np.array(vertices)
    given, colors = rows[:, 3:], None
    if not np.isnan(given).all():
        colors = vertex_colors(given / (255.0 if np.nanmax(given) > 1 else 1.0))
    plain = Material(color=GREY if colors is None else WHITE)
    return Mesh.from_polygons(
        rows[:, :3],
        indices[:, 0] - 1,
        np.array(sizes),
        corner_uv=np.array(coordinates)[indices[:, 1]] if named[:, 1].any() else None,
        polygon_material=rows_of.reshape(-1),
        vertex_colors=colors,
        materials=tuple(known.get(name, plain) for name in names),
        source=str(path),
    )


@lru_cache(maxsize=2**16)  # several faces share a corner
def _parse_corner(word: bytes) -> tuple[int, int]:
    """Parse a corner (``v``, ``v/vt``, ``v//vn``, ...) to (vertex, texture coordinate or 0)."""
    vertex, *others = word.split(b"/")
    values = [int(each or b"0") for each in others]
    if len(values) > 2:
        raise ValueError(f"{word!r} is not a corner")
    return int(vertex), values[0] if values else 0


_HEADER_END = re.compile(rb"^end_header[ \t]*(?:\r?\n|\Z)", re.MULTILINE)
_LENGTH = "length of "  # prefix of the field with a list's length
_INDICES = ("vertex_indices", "vertex_index")
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# NumPy's type codes by PLY's type names.
_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip

_STL_HEADER = 84
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_STL_FACET = re.compile(rb"\bfacet\s+normal\b", re.IGNORECASE)
_STL_CORNER = re.compile(rb"\bvertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)
_OFF_WORD = re.compile(rb"(?:ST)?C?N?OFF(.*)", re.IGNORECASE)


@dataclass
class _Element:
    """An element; ``properties`` maps names to (type,) or, for a list, (length type, type)."""

    name: str
    count: int
    properties: dict[str, tuple[str, ...]] = field(default_factory=dict)


def read_ply(data: bytes, path: Path) -> Mesh:
    """Read the content of a PLY file; users call `cadalign.load_mesh`.

    Vertex colours are read; textures and face colours are ignored. Text is first converted to
    binary data of doubles.
    """
    if data[:100].split(maxsplit=1)[:1] not in ([b"ply"], [b"PLY"]):
        raise DataError("not a PLY file", fix="give a file that begins with 'ply'")
    end = _HEADER_END.search(data)
    if end is None:
        raise damage_error("the PLY header has no end")
    form, elements = _header(data[: end.start()].decode("utf-8", errors="replace"))
    data, place = data[end.end() :], 0
    if form == "ascii":
        data = parse_numbers(data, len(data.split())).tobytes()
    read: dict[str, list[Any]] = {}
    for each in elements:
        read[each.name], place = _blocks(data, place, each, form, path)
    require_count("bytes", place, len(data), len(data) - place, path)
    faces = read.get("face", [])
    name = next((name for name in _INDICES if faces and name in faces[0].dtype.names), None)
    if name is None:
        raise DataError("the PLY file has no faces")
    (kinds,) = (each.properties for each in elements if each.name == "vertex")
    colors = None
    if kinds.keys() >= {"red", "green", "blue"}:
        channels = [each for each in ("red", "green", "blue", "alpha") if each in kinds]
        codes = [kinds[each][-1] for each in channels]
        scales = [1 if code in "fd" else np.iinfo(np.dtype(code)).max for code in codes]
        colors = vertex_colors(_columns(read["vertex"], channels) / scales)
    return Mesh.from_polygons(
        _columns(read["vertex"], "xyz").astype(np.float64),
        np.concatenate([block[name].ravel() for block in faces]).astype(np.int64),
        np.concatenate([np.full(len(block), block[name].shape[1]) for block in faces]),
        vertex_colors=colors,
        materials=(Material(color=GREY if colors is None else WHITE),),
        source=str(path),
    )


def _header(text: str) -> tuple[str, list[_Element]]:
    form, elements = "", list[_Element]()
    for line in text.splitlines():
        match line.split():
            case ["format", name, *_]:
                form = name
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
            case ["property", "list", counted, kind, name]:
                elements[-1].properties[name] = (_CODES[counted], _CODES[kind])
            case ["property", kind, name]:
                elements[-1].properties[name] = (_CODES[kind],)
    return form, elements


def _blocks(
    data: bytes, place: int, element: _Element, form: str, path: Path
) -> tuple[list[Any], int]:
    """Read an element's rows; returns arrays of rows with equal list lengths, and the end."""
    blocks, left, wanted = list[Any](), element.count if element.properties else 0, element.count
    while left > 0:
        kind = _row_type(data, place, element, form)
        count = min(left, wanted, (len(data) - place) // kind.itemsize)
        rows: Any = np.ndarray(count, kind, data, place)
        if not count:
            what = {"vertex": "vertices", "face": "faces"}.get(element.name, element.name)
            require_count(what, element.count, element.count - left, 0, path)
        names = [name for name in rows.dtype.names or () if name.startswith(_LENGTH)]
        differs = np.any([rows[name] != rows[name][0] for name in names], axis=0)
        count = int(np.argmax(differs)) if np.any(differs) else len(rows)
        blocks.append(rows[:count])
        place, left, wanted = place + blocks[-1].nbytes, left - count, 2 * count
    return blocks, place


def _row_type(data: bytes, place: int, element: _Element, form: str) -> np.dtype[Any]:
    """The type of the row at a place, with its list lengths; 0 beyond the end of the data."""
    fields: list[tuple[Any, ...]] = []
    for name, codes in element.properties.items():
        kinds = [_ORDERS[form] + ("d" if form == "ascii" else code) for code in codes]
        if len(kinds) > 1:
            length, start = np.dtype(kinds[0]), place + np.dtype(fields).itemsize
            given = data[start : start + length.itemsize].ljust(length.itemsize, b"\0")
            count = int(np.frombuffer(given, length)[0])
            fields += [(_LENGTH + name, length), (name, kinds[1], (count,))]
        else:
            fields.append((name, kinds[0]))
    return np.dtype(fields)


def _columns(blocks: list[Any], names: Iterable[str]) -> npt.NDArray[Any]:
    """Stack properties of all rows, (n, k)."""
    return np.stack([np.concatenate([block[name] for block in blocks]) for name in names], axis=1)


def read_stl(data: bytes, path: Path) -> Mesh:
    """Read the content of an STL file, text or binary; faces do not share vertices."""
    found = _STL_CORNER.findall(data) if data.lstrip()[:5].lower() == b"solid" else []
    if found:
        announced, end = len(_STL_FACET.findall(data)), data.lower().rfind(b"endsolid")
        if end < 0 or len(found) != 3 * announced:
            raise damage_error(f"the text ends before 'endsolid', after {len(found) // 3} faces")
        surplus = len(data[end:].partition(b"\n")[2].strip())
        require_count("faces", announced, announced, surplus, path)
        corners = parse_numbers(b" ".join(found), 3 * len(found))
    else:
        if len(data) < _STL_HEADER:
            raise damage_error(f"{len(data)} bytes, but the header alone has {_STL_HEADER}")
        announced = int.from_bytes(data[80:_STL_HEADER], "little")
        size = len(data) - _STL_HEADER
        surplus = size - announced * _STL_FACE.itemsize
        require_count("faces", announced, size // _STL_FACE.itemsize, surplus, path)
        corners = np.frombuffer(data, _STL_FACE, announced, _STL_HEADER)["corners"]
    vertices = corners.reshape(-1, 3).astype(np.float64)
    return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), source=str(path))


def read_off(data: bytes, path: Path) -> Mesh:
    """Read the content of an OFF file; colours are ignored."""
    rows = [row for line in data.splitlines() if (row := line.partition(b"#")[0].split())]
    found = _OFF_WORD.fullmatch(rows[0][0]) if rows else None
    if found is None or rows[0][1:2] == [b"BINARY"]:
        what = "not an OFF file of text with three dimensions"
        raise DataError(what, fix="give a file that begins with 'OFF'")
    # Some files have the counts in the first line, even without a blank before them.
    counts = [each for each in (found[1], *rows[0][1:]) if each]
    if not counts:
        counts, rows = rows[1], rows[1:]
    vertices, faces = int(counts[0]), int(counts[1])
    if min(vertices, faces) < 1:
        raise damage_error(f"the header announces {vertices} vertices and {faces} faces")
    lines, last = rows[1:], vertices + faces
    require_count("vertices", vertices, len(lines), 0, path)
    surplus = sum(map(len, chain(*lines[last:])))
    require_count("faces", faces, len(lines) - vertices, surplus, path)
    points, polygons = lines[:vertices], lines[vertices:last]
    for number, row in enumerate(polygons):
        if not row[0].isdigit() or len(row) <= int(row[0]):
            what = f"face {number} is {brief(b' '.join(row).decode('ascii', 'replace'))!r}"
            raise damage_error(f"{what}, after the announced {vertices} vertices")
    sizes = np.array([int(row[0]) for row in polygons], dtype=np.int64)
    corners = b" ".join(b" ".join(row[1 : 1 + int(row[0])]) for row in polygons)
    coordinates = b" ".join(b" ".join(row[:3]) for row in points)
    return Mesh.from_polygons(
        parse_numbers(coordinates, 3 * vertices).reshape(-1, 3),
        parse_numbers(corners, int(sizes.sum()), np.int64),
        sizes,
        source=str(path),
    )
