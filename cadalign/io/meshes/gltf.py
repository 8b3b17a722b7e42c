"""Read glTF 2.0 files, text or binary, as one mesh.

See the Khronos Group's specification of glTF 2.0 and of its extensions. A part that is missing or
has another type raises one of Python's errors, which `cadalign.load_mesh` converts to DataError.

trimesh is not used: it does not scale normalized integers, ignores the changes of sparse accessors,
and allocates arrays without data.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, brief, quote
from cadalign.geometry.mesh import GREY, Material, Mesh, join
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.io.documents import parse_json
from cadalign.io.files import damage_error, guard_reading, read_bytes, require_count
from cadalign.io.meshes.materials import WHITE, Texture, Textures, find_reference, vertex_colors

_Part = dict[str, Any]
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# Extensions that are supported here, or affect only shading and light.
_EXTENSIONS = (
    *("EXT_texture_webp", "KHR_lights_", "KHR_materials_", "KHR_mesh_quantization"),
    *("KHR_texture_transform", "KHR_xmp_json_ld"),
)
_TRIANGLES, _STRIP, _FAN = 4, 5, 6  # modes of primitives; others are points and lines
_FREE_FACES = 2**20  # always allowed in a scene; a face takes up to 256 bytes


def read_gltf(data: bytes, path: Path) -> Mesh:
    """Read the content of a glTF or GLB file; its nodes are transformed and joined to one mesh.

    Skins and morph targets are ignored.

    Raises DataError if the file is not glTF 2.0, has no faces, its nodes form no tree, it requires
    an unsupported extension, or its nodes repeat meshes to more than a million faces plus one per
    two bytes of its buffers.
    """
    text, binary = _split_chunks(data, path) if data[:4] == b"glTF" else (data, b"")
    with guard_reading(path):
        document = parse_json(str(text, "utf-8-sig"), str(path))
    _check(document)
    file = _GltfFile(path, document, binary)
    placed = [
        (primitive, transform)
        for number, transform in _placements(document)
        for primitive in _get_part(document, "meshes", number)["primitives"]
        if _count_faces(document, primitive)
    ]
    if not placed:
        raise DataError("the file has no faces", fix="is it complete?")
    # A node of 20 bytes can repeat a whole mesh.
    faces = sum(_count_faces(document, primitive) for primitive, _ in placed)
    if faces > _FREE_FACES + file.size // 2:
        what = f"its nodes repeat meshes to {faces} faces, too many for {file.size} bytes"
        raise DataError(what, fix="simplify the meshes, or remove copies")
    distinct = {id(primitive): primitive for primitive, _ in placed}
    surfaces = {key: file.surface(primitive) for key, primitive in distinct.items()}
    return join([_transform(surfaces[id(primitive)], at) for primitive, at in placed], str(path))


class _GltfFile:
    """A file's document and buffers; ``size`` is the buffers' number of bytes."""

    def __init__(self, path: Path, document: _Part, binary: bytes) -> None:
        self.path, self.document = path, document
        uris = [each.get("uri") for each in document.get("buffers", [])]
        named = {uri: self._resource(uri) if uri else binary for uri in dict.fromkeys(uris)}
        self.size = sum(map(len, named.values()))
        self._buffers = [named[uri] for uri in uris]
        self._textures = Textures()
        self._materials = [self._material(part) for part in document.get("materials", [])]

    def _resource(self, uri: str) -> bytes:
        """Decode a ``data:`` URI, or read the file that the URI names."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition("base64,")[2])
        return read_bytes(self.path.parent / unquote(uri))

    def _view(self, number: int) -> memoryview:
        part = _get_part(self.document, "bufferViews", number)
        announced = _get_part(self.document, "buffers", part["buffer"])["byteLength"]
        data = self._buffers[part["buffer"]]
        start, length = part.get("byteOffset", 0), part["byteLength"]
        if len(data) < announced or not 0 <= start <= start + length <= len(data):
            what = f"{len(data)} bytes in its buffer, {max(announced, start + length)} announced"
            raise damage_error(what, f"bufferViews[{number}]")
        return memoryview(data)[start : start + length]

    def _array(self, number: int) -> npt.NDArray[Any]:
        """Read an accessor's array (n, width); normalized integers become fractions."""
        accessor = _get_part(self.document, "accessors", number)
        if "sparse" in accessor or "bufferView" not in accessor:
            what = "sparse accessors, and accessors without data, are not supported"
            raise DataError(what, where=f"accessors[{number}]", fix="export the file without them")
        dtype, width = np.dtype(_NUMBERS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        data, row = self._view(accessor["bufferView"]), width * dtype.itemsize
        stride = self.document["bufferViews"][accessor["bufferView"]].get("byteStride", row)
        count, offset = accessor["count"], accessor.get("byteOffset", 0)
        needed = offset + (count - 1) * stride + row
        if min(count - 1, offset, stride - row) < 0 or needed > len(data):
            what = f"{count} values of {row} bytes do not fit into {len(data)} bytes"
            raise damage_error(what, f"accessors[{number}]")
        strides = (stride, dtype.itemsize)
        values = np.ndarray((count, width), dtype, buffer=data, offset=offset, strides=strides)
        if accessor.get("normalized") and dtype.kind != "f":
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _material(self, part: _Part) -> tuple[Material, _Part]:
        """Convert a material; returns it with its reference to a texture."""
        metallic = part.get("pbrMetallicRoughness", {})
        older = part.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        factor = metallic.get("baseColorFactor") or older.get("diffuseFactor")
        use = metallic.get("baseColorTexture") or older.get("diffuseTexture") or {}
        texture = self._texture(use["index"]) if use else None
        material = Material(str(part.get("name", "")), GREY if texture is None else WHITE, texture)
        if factor is not None:
            red, green, blue, opacity = _to_srgb(np.clip(factor, 0, 1)).tolist()
            material = replace(material, color=(red, green, blue, opacity))
        return material, use

    def _texture(self, number: int) -> Texture | None:
        part = _get_part(self.document, "textures", number)
        source = part.get("extensions", {}).get("EXT_texture_webp", part).get("source")
        if source is None:
            return None
        image = _get_part(self.document, "images", source)
        picture: Path | bytes = b""
        if "uri" not in image:
            picture = bytes(self._view(image["bufferView"]))
        elif image["uri"].startswith("data:"):
            picture = self._resource(image["uri"])
        else:
            picture = find_reference(self.path, unquote(image["uri"]))
        return self._textures.read(picture, name=f"images[{source}]", within=self.path)

    def surface(self, primitive: _Part) -> Mesh:
        """Read a primitive as a mesh in its own frame."""
        attributes, material, colors, uv = primitive["attributes"], Material(), None, None
        if "material" in primitive:
            material, use = self._materials[primitive["material"]]
            uv = None if material.texture is None else self._texture_coordinates(attributes, use)
        vertices = self._array(attributes["POSITION"]).astype(np.float64)
        corners = np.arange(len(vertices))
        if "indices" in primitive:
            corners = self._array(primitive["indices"])[:, 0].astype(np.int64)
        faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        if "COLOR_0" in attributes:
            values = self._array(attributes["COLOR_0"])
            # Exporters omit the flag that integers are normalized.
            scale = 1.0 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
            colors = _to_srgb(vertex_colors(values / scale))
        if len(vertices) > faces.size:  # vertices are shared with other primitives
            kept, faces = np.unique(faces, return_inverse=True)
            vertices, faces = vertices[kept], faces.reshape(-1, 3)
            uv, colors = (None if each is None else each[kept] for each in (uv, colors))
        if "material" not in primitive and colors is not None:
            material = Material(color=WHITE)
        uv = None if uv is None else uv[faces]
        return Mesh(vertices, faces, vertex_colors=colors, corner_uv=uv, materials=(material,))

    def _texture_coordinates(self, attributes: _Part, use: _Part) -> FloatArray | None:
        """Texture coordinates (n, 2), converted from glTF's origin top left to bottom left."""
        change = use.get("extensions", {}).get("KHR_texture_transform", {})
        name = f"TEXCOORD_{change.get('texCoord', use.get('texCoord', 0))}"
        if name not in attributes:
            return None
        cos, sin = np.cos(change.get("rotation", 0.0)), np.sin(change.get("rotation", 0.0))
        scaled = self._array(attributes[name]) * change.get("scale", (1, 1))
        turned = scaled @ np.array([[cos, -sin], [sin, cos]]) + change.get("offset", (0, 0))
        return np.asarray(turned * (1, -1) + (0, 1))


def _split_chunks(data: bytes, path: Path) -> tuple[bytes, bytes]:
    """Split a GLB file into its document and its binary part."""
    found = {b"JSON": b"", b"BIN\0": b""}
    place = 12
    for kind in found:
        if data[place + 4 : place + 8] == kind:
            end = place + 8 + int.from_bytes(data[place : place + 4], "little")
            found[kind], place = data[place + 8 : end], end
    announced = max(place, int.from_bytes(data[8:12], "little"))
    require_count("bytes", announced, len(data), max(len(data) - announced, 0), path)
    return found[b"JSON"], found[b"BIN\0"]


def _check(document: _Part) -> None:
    """Raise DataError for another version or an unsupported required extension."""
    version = document["asset"]["version"]
    if not version.startswith("2."):
        what = f"the file has glTF version {quote(version)}; only version 2 is supported"
        raise DataError(what, where="asset")
    required = document.get("extensionsRequired", [])
    if unknown := [name for name in required if not name.startswith(_EXTENSIONS)]:
        what = f"the file requires {brief(', '.join(unknown))}, which is not supported"
        fix = "export it without this extension, such as without compressed geometry"
        raise DataError(what, where="extensionsRequired", fix=fix)


def _get_part(document: _Part, name: str, number: int) -> _Part:
    """Return a numbered part of one of the document's lists; negative numbers count nothing."""
    parts: list[_Part] = document[name]
    return parts[number if number >= 0 else len(parts)]


def _placements(document: _Part) -> Iterator[tuple[int, FloatArray]]:
    """Yield mesh numbers and transforms, in depth-first order of the scene's nodes."""
    roots = _get_part(document, "scenes", document.get("scene", 0)).get("nodes", [])
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        number, parent = waiting.pop()
        if number in seen:
            what = "the node has two parents, or is its own ancestor"
            raise DataError(what, where=f"nodes[{number}]", fix="nodes must form a tree")
        seen.add(number)
        node = _get_part(document, "nodes", number)
        transform = parent @ _local_transform(node)
        if "mesh" in node:
            yield node["mesh"], transform
        waiting += [(child, transform) for child in reversed(node.get("children", []))]


def _local_transform(node: _Part) -> FloatArray:
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
    """Number of a primitive's triangles; 0 for points and lines."""
    position, mode = primitive["attributes"].get("POSITION"), primitive.get("mode", _TRIANGLES)
    if mode in (_STRIP, _FAN):
        what = "triangle strips and fans are not supported"
        raise DataError(what, where="meshes", fix="export single triangles")
    if position is None or mode != _TRIANGLES:
        return 0
    count: int = _get_part(document, "accessors", primitive.get("indices", position))["count"]
    return count // 3


def _to_srgb(colors: FloatArray) -> FloatArray:
    """Convert linear colour factors and vertex colours (..., 4) to sRGB."""
    from trimesh.visual.color import linear_to_srgb  # takes time to import

    return np.concatenate([linear_to_srgb(colors[..., :3]), colors[..., 3:]], axis=-1)


def _transform(mesh: Mesh, transform: FloatArray) -> Mesh:
    """Transform a mesh by a matrix (4, 4); a mirroring one reverses the triangles."""
    vertices = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
    if np.linalg.det(transform[:3, :3]) >= 0:
        return replace(mesh, vertices=vertices)
    uv = None if mesh.corner_uv is None else mesh.corner_uv[:, ::-1]
    return replace(mesh, vertices=vertices, faces=mesh.faces[:, ::-1], corner_uv=uv)
