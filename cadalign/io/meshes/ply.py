"""PLY files, text or binary, with their faces in file order.

The format: Greg Turk, "The PLY polygon file format", 1994. Text is read as binary data whose
numbers are all double.
"""

from __future__ import annotations

import io
import struct
from codecs import BOM_UTF8
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray, parse_numbers
from cadalign.errors import DataError
from cadalign.geometry.mesh import GREY, Material, Mesh, fan_triangles
from cadalign.io.files import damaged, read_bytes, require_count
from cadalign.io.meshes.materials import WHITE, Textures

_MAX_HEADER_LINES = 1000
_INDICES = ("vertex_indices", "vertex_index")
_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# PLY's names of numbers, as NumPy and `struct` have them.
_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip


@dataclass
class _Element:
    """An element: its name and number; by the name of a property its code, a list's also before."""

    name: str
    count: int
    properties: dict[str, tuple[str, ...]] = field(default_factory=dict)


def read_ply(path: Path) -> Mesh:
    """Read a PLY file; `cadalign.load_mesh` is the public way to it."""
    file = io.BytesIO(read_bytes(path).removeprefix(BOM_UTF8))
    form, elements, texture_name = _header(file, path)
    kinds = {each.name: each.properties for each in elements}
    data, place = file.read(), 0
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
        raise DataError("the PLY file has no faces", where=str(path))
    sizes = np.fromiter(map(len, polygons), np.int64, len(polygons))
    if sizes.min() < 3:
        raise damaged(f"face {int(sizes.argmin())} has {sizes.min()} corners", path)
    corners = np.array([*chain(*polygons)] if isinstance(polygons, list) else polygons)
    corners = corners.ravel().astype(np.int64)
    triangles, polygon = fan_triangles(sizes)
    texture = Textures().read(path, texture_name) if texture_name else None
    uv = None if texture is None else _texture_coordinates(vertex, face, corners)
    colors = _colors(vertex, kinds["vertex"])
    face_colors = None if colors is not None else _colors(face, kinds["face"])
    materials: tuple[Material, ...] = (Material(color=GREY if colors is None else WHITE),)
    face_material = np.empty(0, dtype=np.int64)
    if uv is not None:
        materials = (Material(color=WHITE, texture=texture),)
    elif face_colors is not None:
        distinct, rows = np.unique(face_colors, axis=0, return_inverse=True)
        materials = tuple(Material(color=tuple(color.tolist())) for color in distinct)
        face_material = rows.reshape(-1)[polygon]
    return Mesh(
        np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64),
        corners[triangles],
        polygon=polygon,
        vertex_colors=colors,
        corner_uv=None if uv is None else uv[triangles],
        materials=materials,
        face_material=face_material,
        source=str(path),
    )


def _header(file: io.BytesIO, path: Path) -> tuple[str, list[_Element], str]:
    """The format, the elements, and the name of a texture."""
    if file.readline(100).strip().lower() != b"ply":
        raise DataError("not a PLY file", where=str(path), fix="does it begin with 'ply'?")
    form, elements, texture = "", list[_Element](), ""
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(10_000).decode("utf-8", errors="replace")
        match line.split():
            case ["end_header"]:
                return form, elements, texture
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
    raise damaged("the PLY header has no end", path)


def _columns(
    data: bytes, place: int, element: _Element, order: str, path: Path
) -> tuple[dict[str, Any], int]:
    """The values of an element's properties (n,), lists as rows, and the place of their end."""
    if not element.count or not element.properties:
        return {}, place
    rows: list[list[Any]] = []
    start = place
    try:
        row, place = _row(data, place, element, order)
        even = _even_columns(data, start, element, order, row)
        if even is not None:
            return even, start + element.count * (place - start)
        rows.append(row)
        while len(rows) < element.count:
            row, place = _row(data, place, element, order)
            rows.append(row)
    except struct.error:
        what = {"vertex": "vertices", "face": "faces"}.get(element.name, element.name)
        require_count(what, element.count, len(rows), 0, path)
    return dict(zip(element.properties, map(list, zip(*rows, strict=True)), strict=True)), place


def _row(data: bytes, place: int, element: _Element, order: str) -> tuple[list[Any], int]:
    """The values of one row of an element, and the place of its end."""
    row: list[Any] = []
    for *counted, code in element.properties.values():
        count = 1
        if counted:
            (number,) = struct.unpack_from(order + counted[0], data, place)
            count, place = int(number), place + struct.calcsize(counted[0])
        values = struct.unpack_from(f"{order}{count}{code}", data, place)
        place += count * struct.calcsize(code)
        row.append(values if counted else values[0])
    return row, place


def _even_columns(
    data: bytes, place: int, element: _Element, order: str, first: list[Any]
) -> dict[str, Any] | None:
    """The columns of an element whose lists are all as long as those of its first row."""
    fields: list[tuple[Any, ...]] = []
    for (name, (*counted, code)), values in zip(element.properties.items(), first, strict=True):
        if counted:
            fields += [(f"{name} count", order + counted[0]), (name, order + code, (len(values),))]
        else:
            fields.append((name, order + code))
    dtype = np.dtype(fields)
    if place + element.count * dtype.itemsize > len(data):
        return None
    rows = np.frombuffer(data, dtype, element.count, place)
    for name, values in zip(element.properties, first, strict=True):
        if isinstance(values, tuple) and (rows[f"{name} count"] != len(values)).any():
            return None
    return {name: rows[name] for name in element.properties}


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
        uv = np.array([*chain(*face["texcoord"])], dtype=float).reshape(-1, 2)
        return uv if len(uv) == len(corners) else None
    for names in _COORDINATES:
        if set(names) <= vertex.keys():
            points = np.stack([vertex[name] for name in names], axis=1)
            return np.asarray(points[corners], dtype=float)
    return None
