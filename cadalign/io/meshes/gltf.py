"""glTF 2.0 files, text or binary, as one mesh.

After the Khronos Group's specification of glTF 2.0 and of the extensions that are named. A part
that is missing or of another type ends in one of Python's errors, which `cadalign.load_mesh` turns
into a DataError.

trimesh takes normalized integers as they stand and sparse values without their changes, makes room
for arrays without data, and knows neither transforms of textures nor what a file says that it
requires.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, brief, quote
from cadalign.geometry.mesh import GREY, Material, Mesh, join
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.io.documents import parse_json
from cadalign.io.files import damaged, read_bytes, reading, require_count
from cadalign.io.meshes.materials import WHITE, Texture, Textures

_Part = dict[str, Any]
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# What they add is read here, or is nothing but the look of surfaces and their light.
_EXTENSIONS = (
    *("EXT_texture_webp", "KHR_lights_punctual", "KHR_mesh_quantization", "KHR_texture_transform"),
    "KHR_xmp_json_ld",
)
_LOOKS = "KHR_materials_"
_TRIANGLES, _STRIP, _FAN = 4, 5, 6  # a primitive's modes; points and lines have others
_FREE_FACES = 2**20  # of a scene; each takes up to 256 bytes


def read_gltf(data: bytes, path: Path) -> Mesh:
    """Read the content of a glTF or GLB file as one mesh, each node placed by its transform.

    Skins and morph targets have no effect.

    Raises DataError if it is no glTF 2.0 file, has no faces, is no tree of nodes, needs an
    extension that is not read, or repeats its meshes to more than a million faces and one for every
    two bytes.
    """
    text, binary = _chunks(data, path) if data[:4] == b"glTF" else (data, b"")
    with reading(path):
        document = parse_json(str(text, "utf-8-sig"), str(path))
    _check(document)
    file = _GltfFile(path, document, len(data), binary)
    placed = [
        (primitive, transform)
        for number, transform in _placements(document)
        for primitive in nth(document, "meshes", number)["primitives"]
        if _count_faces(document, primitive)
    ]
    if not placed:
        raise DataError("the file has no faces", fix="is it whole?")
    # A node of some 20 bytes repeats a whole mesh.
    faces = sum(_count_faces(document, primitive) for primitive, _ in placed)
    if faces > _FREE_FACES + file.size // 2:
        what = f"its nodes repeat meshes to {faces} faces, from {file.size} bytes"
        raise DataError(what, fix="simplify it, or leave copies out")
    distinct = {id(primitive): primitive for primitive, _ in placed}
    surfaces = {key: _surface(file, primitive) for key, primitive in distinct.items()}
    return join([_moved(surfaces[id(primitive)], at) for primitive, at in placed], str(path))


class _GltfFile:
    """The document of a file, and what its buffers hold; ``size`` is the bytes of all files."""

    def __init__(self, path: Path, document: _Part, size: int, binary: bytes) -> None:
        self.path, self.document, self.size = path, document, size
        self._textures = Textures()
        uris = [each.get("uri") for each in document.get("buffers", [])]
        named: dict[str | None, bytes] = {None: binary}
        for uri in uris:
            if uri not in named:
                data = _embedded(uri)
                named[uri] = read_bytes(path.parent / unquote(uri)) if data is None else data
                self.size += len(named[uri]) if data is None else 0
        self._buffers = [named[uri] for uri in uris]
        self.looks = [self._look(part) for part in document.get("materials", [])]
        """Materials, and their references to textures, empty where they have none."""

    def view(self, number: int) -> memoryview:
        """The bytes of a buffer view."""
        part = nth(self.document, "bufferViews", number)
        announced = nth(self.document, "buffers", part["buffer"])["byteLength"]
        data = self._buffers[part["buffer"]]
        start, length = part.get("byteOffset", 0), part["byteLength"]
        if len(data) < announced or not 0 <= start <= start + length <= len(data):
            what = f"{len(data)} bytes in its buffer, {max(announced, start + length)} announced"
            raise damaged(what, f"bufferViews[{number}]")
        return memoryview(data)[start : start + length]

    def array(self, number: int) -> npt.NDArray[Any]:
        """The array (n, width) of an accessor; of normalized integers as fractions."""
        accessor = nth(self.document, "accessors", number)
        if "sparse" in accessor or "bufferView" not in accessor:
            what = "sparse values, or none, are not read"
            raise DataError(what, where=f"accessors[{number}]", fix="export it without them")
        dtype, width = np.dtype(_NUMBERS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        data, row = self.view(accessor["bufferView"]), width * dtype.itemsize
        stride = self.document["bufferViews"][accessor["bufferView"]].get("byteStride", row)
        count, offset = accessor["count"], accessor.get("byteOffset", 0)
        if stride < row or offset < 0 or offset + (count - 1) * stride + row > len(data):
            what = f"{count} values of {row} bytes do not fit into {len(data)} bytes"
            raise damaged(what, f"accessors[{number}]")
        strides = (stride, dtype.itemsize)
        values = np.ndarray((count, width), dtype, buffer=data, offset=offset, strides=strides)
        if accessor.get("normalized") and dtype.kind != "f":
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def attribute(self, primitive: _Part, name: str, width: int = 0) -> npt.NDArray[Any]:
        """The values (n, width) of a primitive's vertices."""
        numbers = primitive["attributes"]
        values = self.array(numbers[name])
        count = self.document["accessors"][numbers["POSITION"]]["count"]
        if len(values) != count or (width and values.shape[1] != width):
            what = f"{values.shape} values of {name} for {count} vertices"
            raise damaged(what, f"accessors[{numbers[name]}]")
        return values

    def _look(self, part: _Part) -> tuple[Material, _Part]:
        metallic = part.get("pbrMetallicRoughness", {})
        older = part.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        factor = metallic.get("baseColorFactor") or older.get("diffuseFactor")
        use = metallic.get("baseColorTexture") or older.get("diffuseTexture") or {}
        texture = self._texture(use["index"]) if use else None
        color = GREY if texture is None else WHITE
        if factor is not None:
            red, green, blue, opacity = _encoded(np.clip(factor, 0, 1)).tolist()
            color = (red, green, blue, opacity)
        material = Material(str(part.get("name", "")), color, texture)
        return material, use if texture is not None else {}

    def _texture(self, number: int) -> Texture | None:
        part = nth(self.document, "textures", number)
        part = {**part, **part.get("extensions", {}).get("EXT_texture_webp", {})}
        if "source" not in part:
            return None
        image = nth(self.document, "images", part["source"])
        uri = image.get("uri", "")
        data = _embedded(uri) if uri else bytes(self.view(image["bufferView"]))
        if data is None:
            return self._textures.read(self.path, unquote(uri))
        return self._textures.decode(data, within=self.path, name=f"images[{part['source']}]")


def nth(document: _Part, name: str, number: int) -> _Part:
    """The part of a list of the document by its number; raises DataError where there is none."""
    parts = document.get(name, [])
    if not 0 <= number < len(parts):
        raise damaged(f"named, but there are {len(parts)} {name}", f"{name}[{number}]")
    found: _Part = parts[number]
    return found


def _embedded(uri: str) -> bytes | None:
    """The data that stand in the text of a ``data:`` URI; None of the name of a file."""
    if not uri.startswith("data:"):
        return None
    form, _, data = uri.partition(",")
    return base64.b64decode(data) if form.endswith(";base64") else unquote_to_bytes(data)


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes]:
    """The document of a GLB file, and its binary part."""
    found: list[bytes] = []
    place = 12
    for kind in (b"JSON", b"BIN\0"):
        length = int.from_bytes(data[place : place + 4], "little")
        if data[place + 4 : place + 8] != kind:
            break
        found.append(data[place + 8 : place + 8 + length])
        place += 8 + length
    announced = max(place, int.from_bytes(data[8:12], "little"))
    surplus = max(len(data) - announced, 0)
    require_count("bytes", announced, len(data), surplus, path)
    if not found:
        raise damaged("the GLB file has no part that describes it", path)
    return found[0], b"".join(found[1:])


def _check(document: _Part) -> None:
    """Refuse other versions, and extensions without which the file means something else."""
    version = document["asset"]["version"]
    if not version.startswith("2."):
        what = f"version {quote(version)} of glTF; only version 2 is read"
        raise DataError(what, where="asset")
    unknown = [
        name
        for name in document.get("extensionsRequired", [])
        if name not in _EXTENSIONS and not name.startswith(_LOOKS)
    ]
    if unknown:
        raise DataError(
            f"{brief(', '.join(unknown))} is needed to read this file, and not known",
            where="extensionsRequired",
            fix="export it without this extension; of compressed geometry, uncompressed",
        )


def _placements(document: _Part) -> Iterator[tuple[int, FloatArray]]:
    """Meshes and their transforms, in the order of the nodes from the scene's roots down."""
    roots = nth(document, "scenes", document.get("scene", 0)).get("nodes", [])
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        number, parent = waiting.pop()
        if number in seen:
            what = "the node has two parents, or is its own ancestor"
            raise DataError(what, where=f"nodes[{number}]", fix="the nodes of a scene are a tree")
        seen.add(number)
        node = nth(document, "nodes", number)
        transform = parent @ _local(node)
        if "mesh" in node:
            yield node["mesh"], transform
        waiting += [(child, transform) for child in reversed(node.get("children", []))]


def _local(node: _Part) -> FloatArray:
    """A node's transform (4, 4) in its parent's frame."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T
    transform = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    if x or y or z:
        transform[:3, :3] = rotation_from_quat_wxyz(np.array([w, x, y, z]))
    transform[:3, :3] *= node.get("scale", (1, 1, 1))
    transform[:3, 3] = node.get("translation", (0, 0, 0))
    return transform


def _count_faces(document: _Part, primitive: _Part) -> int:
    """The number of a primitive's triangles; 0 of points and lines."""
    position, mode = primitive["attributes"].get("POSITION"), primitive.get("mode", _TRIANGLES)
    if mode in (_STRIP, _FAN):
        what = "strips and fans of triangles are not read"
        raise DataError(what, where="meshes", fix="export single triangles")
    if position is None or mode != _TRIANGLES:
        return 0
    count: int = nth(document, "accessors", primitive.get("indices", position))["count"]
    return count // 3


def _surface(file: _GltfFile, primitive: _Part) -> Mesh:
    """The mesh of a primitive in its own frame."""
    material, use = Material(), _Part()
    if "material" in primitive:
        material, use = file.looks[primitive["material"]]
    vertices = file.attribute(primitive, "POSITION", 3).astype(np.float64)
    corners = np.arange(len(vertices))
    if "indices" in primitive:
        corners = file.array(primitive["indices"])[:, 0].astype(np.int64)
    faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
    uv, colors = _texture_coordinates(file, primitive, use), _colors(file, primitive)
    if len(vertices) > faces.size:  # they are shared with other primitives
        kept, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[kept], faces.reshape(-1, 3)
        uv, colors = (None if each is None else each[kept] for each in (uv, colors))
    if "material" not in primitive and colors is not None:
        material = Material(color=WHITE)
    uv = None if uv is None else uv[faces]
    return Mesh(vertices, faces, vertex_colors=colors, corner_uv=uv, materials=(material,))


def _texture_coordinates(file: _GltfFile, primitive: _Part, use: _Part) -> FloatArray | None:
    """Texture coordinates (n, 2) from the bottom left, which glTF has from the top left."""
    change = use.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{change.get('texCoord', use.get('texCoord', 0))}"
    if not use or name not in primitive["attributes"]:
        return None
    uv = file.attribute(primitive, name, 2)
    cos, sin = np.cos(change.get("rotation", 0.0)), np.sin(change.get("rotation", 0.0))
    turned = uv * change.get("scale", (1, 1)) @ np.array([[cos, -sin], [sin, cos]])
    turned = turned + change.get("offset", (0, 0))
    return np.stack([turned[:, 0], 1 - turned[:, 1]], axis=1)


def _colors(file: _GltfFile, primitive: _Part) -> FloatArray | None:
    """Vertex colours (n, 4), sRGB from 0 to 1."""
    if "COLOR_0" not in primitive["attributes"]:
        return None
    values = file.attribute(primitive, "COLOR_0")
    if values.dtype.kind in "ui":  # of exporters that leave out that they are normalized
        values = values / np.iinfo(values.dtype).max
    colors = np.ones((len(values), 4))
    colors[:, : values.shape[1]] = np.nan_to_num(np.clip(values, 0, 1))
    return _encoded(colors)


def _encoded(colors: FloatArray) -> FloatArray:
    """glTF's factors and vertex colours (..., 4), which are linear light, as sRGB."""
    from trimesh.visual.color import linear_to_srgb  # takes time to import

    return np.concatenate([linear_to_srgb(colors[..., :3]), colors[..., 3:]], axis=-1)


def _moved(mesh: Mesh, transform: FloatArray) -> Mesh:
    """A mesh at the transform (4, 4) of a node; mirrored, its triangles are turned round."""
    vertices = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
    if np.linalg.det(transform[:3, :3]) >= 0:
        return replace(mesh, vertices=vertices)
    uv = None if mesh.corner_uv is None else mesh.corner_uv[:, ::-1]
    return replace(mesh, vertices=vertices, faces=mesh.faces[:, ::-1], corner_uv=uv)
