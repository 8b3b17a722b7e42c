"""Mesh files that trimesh reads: PLY with its faces in file order, STL and OFF.

Trimesh gets bytes, never a path: it would open whatever a file names, pictures of any format too.
"""

from __future__ import annotations

import io
import struct
import warnings
from codecs import BOM_UTF8
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from cadalign.arrays import IntArray
from cadalign.errors import CadalignError, DataError
from cadalign.geometry.mesh import GREY, Material, Mesh, join
from cadalign.io.files import damaged, read_bytes
from cadalign.io.meshes.materials import WHITE, Texture, Textures
from cadalign.io.meshes.obj import fan_triangles

_MAX_HEADER_LINES = 1000
_INDICES = ("vertex_indices", "vertex_index")
# PLY's names of numbers, as `struct` has them.
_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip


def read_ply(path: Path) -> Mesh:
    """Read a PLY file, ASCII or binary; `cadalign.load_mesh` is the public way to it."""
    data = read_bytes(path).removeprefix(BOM_UTF8)
    with _parsing(path):
        header = _header(data, path)
        if not header.count("face"):
            raise DataError("the PLY file has no faces", where=str(path))
        cut = _triangulated(data, header, path)
        polygon = None
        if cut is not None:
            data, polygon = cut
        mesh = trimesh.load(io.BytesIO(data), "ply", skip_materials=True, process=False)
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.vertices) or mesh.visual is None:
            raise damaged("no triangles could be read", path)
        textured = mesh.visual.kind == "texture"
        vertices, faces = header.count("vertex"), header.count("face")
        if len(mesh.vertices) < vertices and not textured:
            raise _short(path, "vertices", len(mesh.vertices), vertices)
        if len(mesh.faces) == faces:
            named = header.texture if textured else ""
            read = _mesh(mesh, path, Textures().read(path, named) if named else None)
            return read if polygon is None else replace(read, polygon=polygon)
        if textured:
            raise DataError("polygons with texture coordinates are not read", where=str(path))
        return _with_polygons(mesh, faces, path)


def read_solids(path: Path) -> Mesh:
    """Read an STL or OFF file as one mesh."""
    data = read_bytes(path)
    with _parsing(path):
        loaded = trimesh.load(io.BytesIO(data), path.suffix.lower()[1:], process=False)
        geometries = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        pieces = [
            _mesh(geometry, path, None)
            for geometry in geometries
            if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)
        ]
        if not pieces:
            raise DataError("the file has no faces", where=str(path), fix="is it whole?")
        mesh = join(pieces, str(path))
        if path.suffix.lower() == ".off":
            declared = _declared_off_faces(data)
            if len(mesh.faces) < declared:
                raise _short(path, "faces", len(mesh.faces), declared)
        return mesh


@contextmanager
def _parsing(path: Path) -> Iterator[None]:
    """Convert all errors on damaged content to `DataError`: trimesh's readers raise any kind."""
    try:
        # Coordinates that are not finite are refused by Mesh; other warnings are about textures.
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
            yield
    except (OSError, CadalignError):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        # Text that is not UTF-8 makes trimesh look for a package that guesses encodings.
        if isinstance(error, ImportError | UnicodeDecodeError):
            reason = "neither whole binary data nor text"
        kind = path.suffix.lstrip(".").upper()
        raise damaged(f"cannot be read as a {kind} file ({reason})", path) from None


@dataclass
class _Element:
    """An element of a PLY file: its number, and the words that declare each property."""

    count: int
    properties: list[list[str]] = field(default_factory=list)


@dataclass
class _Header:
    """A PLY file's header: its elements by name, the name of a texture, and where it ends."""

    form: str = ""
    elements: dict[str, _Element] = field(default_factory=dict)
    texture: str = ""
    end: int = 0

    def count(self, name: str) -> int:
        """The number of an element, 0 where there is none."""
        return self.elements[name].count if name in self.elements else 0

    @property
    def text(self) -> bytes:
        """The header as a file has it, without comments."""
        lines = ["ply", f"format {self.form} 1.0"]
        for name, element in self.elements.items():
            lines.append(f"element {name} {element.count}")
            lines += [f"property {' '.join(words)}" for words in element.properties]
        return "\n".join([*lines, "end_header", ""]).encode()


def _header(data: bytes, path: Path) -> _Header:
    file, found = io.BytesIO(data), _Header()
    if file.readline(100).strip().lower() != b"ply":
        raise DataError("not a PLY file", where=str(path), fix="does it begin with 'ply'?")
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(10_000)
        words = line.split()
        text = [word.decode("ascii", errors="replace") for word in words]
        if words == [b"end_header"]:
            found.end = file.tell()
            return found
        if len(words) > 1 and words[0] == b"format":
            found.form = text[1]
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit():
            found.elements[text[1]] = _Element(int(words[2]))
        if len(words) > 2 and words[0] == b"property" and found.elements:
            list(found.elements.values())[-1].properties.append(text[1:])
        if len(words) > 2 and [word.lower() for word in words[:2]] == [b"comment", b"texturefile"]:
            found.texture = line.split(maxsplit=2)[2].strip().decode("utf-8", errors="replace")
    raise damaged("the PLY header has no end", path)


def _triangulated(data: bytes, header: _Header, path: Path) -> tuple[bytes, IntArray] | None:
    """A binary PLY file with its polygons cut into triangles, and the polygon (m,) of each.

    For trimesh, which takes the first list's length for that of all. None of a file that it reads:
    one of text, or whose polygons have one size.
    """
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(header.form)
    face = header.elements["face"]
    if order is None or not any(words[-1] in _INDICES for words in face.properties):
        return None
    start = header.end
    for element in takewhile(lambda each: each is not face, header.elements.values()):
        if any(words[0] == "list" for words in element.properties):
            return None
        row = "".join(_CODES[words[0]] for words in element.properties)
        start += element.count * struct.calcsize(order + row)
    if _is_even(data, start, face, order):
        return None
    polygons, scalars, place = list[tuple[int, ...]](), list[bytes](), start
    for _ in range(face.count):
        for words in face.properties:
            kind, count = words[0], 1
            if kind == "list":
                _, counted, kind, name = words
                (count,) = struct.unpack_from(order + _CODES[counted], data, place)
                place += struct.calcsize(_CODES[counted])
                if name in _INDICES:
                    polygons.append(
                        struct.unpack_from(f"{order}{count}{_CODES[kind]}", data, place)
                    )
            size = count * struct.calcsize(_CODES[kind])
            if words[0] != "list":
                scalars.append(data[place : place + size])
            place += size
    sizes = np.array([len(each) for each in polygons], dtype=np.int64)
    if sizes.min() < 3:
        raise damaged(f"face {int(sizes.argmin())} has {sizes.min()} corners", path)
    triangles, polygon = fan_triangles(sizes)
    kept = [words for words in face.properties if words[0] != "list"]
    of_row = b"".join(scalars)
    width = len(of_row) // face.count
    rows = np.empty(len(triangles), [("n", "u1"), ("v", f"{order}i4", 3), ("rest", f"V{width}")])
    rows["n"], rows["v"] = 3, np.array(list(chain(*polygons)))[triangles]
    if width:
        rows["rest"] = np.frombuffer(of_row, f"V{width}")[polygon]
    face.properties = [["list", "uchar", "int", _INDICES[0]], *kept]
    face.count = len(triangles)
    return header.text + data[header.end : start] + rows.tobytes() + data[place:], polygon


def _is_even(data: bytes, start: int, element: _Element, order: str) -> bool:
    """True if all lists of a property of an element have one length."""
    place, counts = start, list[tuple[int, np.dtype[Any], int]]()
    for words in element.properties:
        kind, count = words[0], 1
        if kind == "list":
            counted, kind = np.dtype(order + _CODES[words[1]]), words[2]
            count = int(np.frombuffer(data, counted, 1, place)[0])
            counts.append((place, counted, count))
            place += counted.itemsize
        place += count * struct.calcsize(_CODES[kind])
    step = place - start
    return start + element.count * step <= len(data) and all(
        (np.ndarray(element.count, counted, data, at, (step,)) == count).all()
        for at, counted, count in counts
    )


def _declared_off_faces(data: bytes) -> int:
    """The number of faces that an OFF file's header announces; trimesh doesn't look at it."""
    file, words = io.BytesIO(data), list[bytes]()
    for _ in range(_MAX_HEADER_LINES):
        words += file.readline(10_000).partition(b"#")[0].split()
        if len(words) >= 3:
            break
    # The counts of vertices and faces follow the word OFF.
    return int(words[2]) if len(words) >= 3 and words[2].isdigit() else 0


def _short(path: Path, what: str, found: int, declared: int) -> DataError:
    return damaged(f"the header announces {declared} {what}, but only {found} are there", path)


def _with_polygons(mesh: Any, declared: int, path: Path) -> Mesh:
    """Cut a PLY file's polygons again, since trimesh lists those of each size together."""
    data = mesh.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    polygons = _polygon_rows(data)
    if len(polygons) < declared:
        raise _short(path, "faces", len(polygons), declared)
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    if sizes.min() < 3:
        raise damaged(f"face {int(sizes.argmin())} has {sizes.min()} corners", path)
    triangles, polygon = fan_triangles(sizes)
    corners = np.concatenate(polygons).astype(np.int64)
    has_colors = mesh.visual.kind == "vertex"
    return Mesh(
        vertices=np.asarray(mesh.vertices, dtype=float),
        faces=corners[triangles],
        polygon=polygon,
        vertex_colors=mesh.visual.vertex_colors / 255.0 if has_colors else None,
        materials=(Material(color=WHITE if has_colors else GREY),),
        source=str(path),
    )


def _polygon_rows(data: Any) -> list[npt.NDArray[Any]]:
    """The vertex numbers of each face out of what trimesh keeps of a PLY file's face element."""
    names = data.keys() if isinstance(data, dict) else getattr(data, "dtype", np.dtype("f8")).names
    for name in ("vertex_indices", "vertex_index"):
        if names and name in names:
            rows = data[name]
            if getattr(rows, "dtype", None) is not None and rows.dtype.names:
                rows = rows["f1"]
            return [np.atleast_1d(row) for row in rows]
    return []


def _mesh(geometry: Any, path: Path, texture: Texture | None) -> Mesh:
    vertices = np.asarray(geometry.vertices, dtype=float)
    faces = np.asarray(geometry.faces, dtype=np.int64)
    visual = geometry.visual
    materials: tuple[Material, ...] = (Material(),)
    face_material = np.zeros(len(faces), dtype=np.int64)
    colors, corner_uv = None, None
    if visual.kind == "texture" and texture is not None:
        materials = (Material(color=WHITE, texture=texture),)
        if visual.uv is not None and len(visual.uv) == len(vertices):
            corner_uv = np.asarray(visual.uv, dtype=float)[faces][:, :, :2]
    elif visual.kind == "vertex":
        materials = (Material(color=WHITE),)
        colors = np.asarray(visual.vertex_colors, dtype=float) / 255
    elif visual.kind == "face":
        distinct, face_material = np.unique(visual.face_colors, axis=0, return_inverse=True)
        materials = tuple(Material(color=tuple((color / 255).tolist())) for color in distinct)
    return Mesh(
        vertices=vertices,
        faces=faces,
        vertex_colors=colors,
        corner_uv=corner_uv,
        materials=materials,
        face_material=face_material.reshape(-1),
        source=str(path),
    )
