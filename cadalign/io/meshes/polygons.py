"""PLY, STL and OFF files, with their faces in file order.

PLY is read after Greg Turk, "The PLY polygon file format", 1994; its text as binary data whose
numbers are all double. trimesh reads no binary PLY whose faces differ in their numbers of corners,
and puts the quads of text and of OFF files behind the triangles.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, parse_numbers
from cadalign.errors import DataError, brief
from cadalign.geometry.mesh import GREY, Material, Mesh
from cadalign.io.files import damaged, require_count
from cadalign.io.meshes.materials import WHITE, Textures

_HEADER_END = re.compile(rb"^end_header[ \t]*(?:\r?\n|\Z)", re.MULTILINE)
_LENGTH = "length of "  # of a list, a field beside it
_INDICES = ("vertex_indices", "vertex_index")
_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# PLY's names of numbers, as NumPy has them.
_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip

_STL_HEADER = 84
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_STL_FACET = re.compile(rb"\bfacet\s+normal\b", re.IGNORECASE)
_STL_CORNER = re.compile(rb"\bvertex\s+(\S+\s+\S+\s+\S+)", re.IGNORECASE)
_OFF_WORD = re.compile(rb"(?:ST)?C?N?(4?n?)OFF(.*)", re.IGNORECASE)


@dataclass
class _Element:
    """An element: its name and number; by the name of a property its code, a list's also before."""

    name: str
    count: int
    properties: dict[str, tuple[str, ...]] = field(default_factory=dict)


def read_ply(data: bytes, path: Path) -> Mesh:
    """Read the content of a PLY file; `cadalign.load_mesh` is the public way to it."""
    if data[:100].split(maxsplit=1)[:1] not in ([b"ply"], [b"PLY"]):
        raise DataError("not a PLY file", fix="does it begin with 'ply'?")
    end = _HEADER_END.search(data)
    if end is None:
        raise damaged("the PLY header has no end")
    form, elements, texture_name = _header(data[: end.start()].decode("utf-8", errors="replace"))
    kinds = {each.name: each.properties for each in elements}
    data, place = data[end.end() :], 0
    if form == "ascii":
        data = parse_numbers(data, len(data.split())).tobytes()
        for each in elements:
            each.properties = {name: ("d",) * len(code) for name, code in each.properties.items()}
    read: dict[str, dict[str, Any]] = {}
    for each in elements:
        read[each.name], place = _columns(data, place, each, _ORDERS[form], path)
    require_count("bytes", place, len(data), len(data) - place, path)
    vertex, face = read.get("vertex", {}), read.get("face", {})
    polygons = next((face[name] for name in _INDICES if name in face), ())
    if not len(polygons):
        raise DataError("the PLY file has no faces")
    sizes = np.fromiter(map(len, polygons), np.int64, len(polygons))
    corners = _flat(polygons).astype(np.int64)
    texture = Textures().read(path, texture_name) if texture_name else None
    uv = None if texture is None else _texture_coordinates(vertex, face, corners)
    colors = _colors(vertex, kinds["vertex"])
    face_colors = None if colors is not None else _colors(face, kinds["face"])
    materials: tuple[Material, ...] = (Material(color=GREY if colors is None else WHITE),)
    material = None
    if uv is not None:
        materials = (Material(color=WHITE, texture=texture),)
    elif face_colors is not None:
        distinct, rows = np.unique(face_colors, axis=0, return_inverse=True)
        materials = tuple(Material(color=tuple(color.tolist())) for color in distinct)
        material = rows.reshape(-1)
    return Mesh.from_polygons(
        np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64),
        corners,
        sizes,
        corner_uv=uv,
        polygon_material=material,
        vertex_colors=colors,
        materials=materials,
        source=str(path),
    )


def _header(text: str) -> tuple[str, list[_Element], str]:
    """The format, the elements, and the name of a texture."""
    form, elements, texture = "", list[_Element](), ""
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
            case [comment, word, *_] if (comment, word.lower()) == ("comment", "texturefile"):
                texture = line.split(maxsplit=2)[2].strip()
    return form, elements, texture


def _columns(
    data: bytes, place: int, element: _Element, order: str, path: Path
) -> tuple[dict[str, Any], int]:
    """The values of an element's properties (n,), lists as rows, and the place of their end."""
    if not element.count or not element.properties:
        return {}, place
    kind, rows = _row_type(data, place, element, order), list[Any]()
    if kind is not None and place + element.count * kind.itemsize <= len(data):
        read = np.frombuffer(data, kind, element.count, place)
        lengths = [read[name] for name in read.dtype.names or () if name.startswith(_LENGTH)]
        if all((each == each[0]).all() for each in lengths):
            return {name: read[name] for name in element.properties}, place + read.nbytes
    while len(rows) < element.count and kind is not None and place + kind.itemsize <= len(data):
        rows.append(np.frombuffer(data, kind, 1, place)[0])
        place += kind.itemsize
        kind = _row_type(data, place, element, order)
    what = {"vertex": "vertices", "face": "faces"}.get(element.name, element.name)
    require_count(what, element.count, len(rows), 0, path)
    return {name: [row[name] for row in rows] for name in element.properties}, place


def _row_type(data: bytes, place: int, element: _Element, order: str) -> np.dtype[Any] | None:
    """The type of the row at a place, by the lengths of its lists; None where the data end."""
    fields: list[tuple[Any, ...]] = []
    for name, (*counted, code) in element.properties.items():
        if counted:
            length, start = np.dtype(order + counted[0]), place + np.dtype(fields).itemsize
            if start + length.itemsize > len(data):
                return None
            count = int(np.frombuffer(data, length, 1, start)[0])
            fields += [(_LENGTH + name, length), (name, order + code, (count,))]
        else:
            fields.append((name, order + code))
    return np.dtype(fields)


def _flat(lists: Any) -> Any:
    """The values of all lists of a column, one after the other."""
    return lists.ravel() if isinstance(lists, np.ndarray) else np.concatenate(lists)


def _colors(columns: dict[str, Any], kinds: dict[str, tuple[str, ...]]) -> FloatArray | None:
    """Colours (n, 4) from 0 to 1."""
    if not columns or not {"red", "green", "blue"} <= columns.keys():
        return None
    colors = np.ones((len(columns["red"]), 4))
    for channel, name in enumerate(("red", "green", "blue", "alpha")):
        if name in columns:
            code = kinds[name][-1]
            scale = 1 if code in "fd" else np.iinfo(np.dtype(code)).max
            colors[:, channel] = np.asarray(columns[name], dtype=float) / scale
    return np.clip(colors, 0, 1)


def _texture_coordinates(
    vertex: dict[str, Any], face: dict[str, Any], corners: Any
) -> FloatArray | None:
    """Texture coordinates of all corners of faces (c, 2)."""
    if "texcoord" in face:
        uv = _flat(face["texcoord"]).astype(float).reshape(-1, 2)
        return uv if len(uv) == len(corners) else None
    for names in _COORDINATES:
        if set(names) <= vertex.keys():
            points = np.stack([vertex[name] for name in names], axis=1)
            return np.asarray(points[corners], dtype=float)
    return None


def read_stl(data: bytes, path: Path) -> Mesh:
    """Read the content of an STL file, text or binary; each face has vertices of its own."""
    found = _STL_CORNER.findall(data) if data.lstrip()[:5].lower() == b"solid" else []
    if found:
        announced = len(_STL_FACET.findall(data))
        require_count("faces", announced, len(found) // 3, 0, path)
        end = data.lower().rfind(b"endsolid")
        if end < 0 or len(found) != 3 * announced:
            raise damaged(f"the text ends before 'endsolid', after {announced} faces")
        behind = data[end:].partition(b"\n")[2].strip()
        require_count("faces", announced, announced, len(behind), path)
        corners = parse_numbers(b" ".join(found), 3 * len(found))
    else:
        if len(data) < _STL_HEADER:
            raise damaged(f"{len(data)} bytes, but the header alone has {_STL_HEADER}")
        announced = int.from_bytes(data[80:_STL_HEADER], "little")
        if not announced:
            raise DataError("the file has no faces", fix="is it whole?")
        size = announced * _STL_FACE.itemsize
        there = (len(data) - _STL_HEADER) // _STL_FACE.itemsize
        require_count("faces", announced, there, len(data) - _STL_HEADER - size, path)
        corners = np.frombuffer(data, _STL_FACE, announced, _STL_HEADER)["corners"]
    vertices = corners.reshape(-1, 3).astype(np.float64)
    return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), source=str(path))


def read_off(data: bytes, path: Path) -> Mesh:
    """Read the content of an OFF file; colours of its vertices and faces are not read."""
    rows = [row for line in data.splitlines() if (row := line.partition(b"#")[0].split())]
    found = _OFF_WORD.fullmatch(rows[0][0]) if rows else None
    if found is None:
        raise DataError("not an OFF file", fix="does it begin with 'OFF'?")
    if found[1] or rows[0][1:2] == [b"BINARY"]:
        kind = "of more than three dimensions" if found[1] else "binary"
        fix = "save it as text of three dimensions"
        raise DataError(f"an OFF file that is {kind} is not read", fix=fix)
    # Some files have the counts in the first line, even without a blank before them.
    counts = [each for each in (found[2], *rows[0][1:]) if each]
    if not counts:
        counts, rows = rows[1], rows[1:]
    vertices, faces = int(counts[0]), int(counts[1])
    if min(vertices, faces) < 1:
        raise damaged(f"the header announces {vertices} vertices and {faces} faces")
    lines, last = rows[1:], vertices + faces
    require_count("vertices", vertices, len(lines), 0, path)
    surplus = sum(map(len, chain(*lines[last:])))
    require_count("faces", faces, len(lines) - vertices, surplus, path)
    points, polygons = lines[:vertices], lines[vertices:last]
    for number, row in enumerate(polygons):
        if not row[0].isdigit() or len(row) <= int(row[0]):
            what = f"face {number} is {brief(b' '.join(row).decode('ascii', 'replace'))!r}"
            raise damaged(f"{what}, behind the {vertices} vertices announced")
    sizes = np.array([int(row[0]) for row in polygons], dtype=np.int64)
    corners = b" ".join(b" ".join(row[1 : 1 + int(row[0])]) for row in polygons)
    coordinates = b" ".join(b" ".join(row[:3]) for row in points)
    return Mesh.from_polygons(
        parse_numbers(coordinates, 3 * vertices).reshape(-1, 3),
        parse_numbers(corners, int(sizes.sum()), np.int64),
        sizes,
        source=str(path),
    )
