"""glTF 2.0 files, text or binary: the document, and the arrays in its buffers.

After the Khronos Group's specification of glTF 2.0 and of the extensions that are named; declared
are the parts that a mesh needs, which `cadalign.io.meshes.gltf_scene` makes of them.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
import numpy.typing as npt
from msgspec import Meta, field

from cadalign.errors import DataError, brief, quote
from cadalign.io.documents import (
    Count,
    Finite,
    ForeignDocument,
    Point2,
    Point3,
    convert,
    in_file,
    parse_json,
)
from cadalign.io.files import damaged, read_bytes, reading

Array = npt.NDArray[Any]
_T = TypeVar("_T")
_Point4 = tuple[Finite, Finite, Finite, Finite]

_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# What they add is read here, or is nothing but the look of surfaces and their light.
_EXTENSIONS = (
    *("EXT_texture_webp", "KHR_lights_punctual", "KHR_mesh_quantization", "KHR_texture_transform"),
    "KHR_xmp_json_ld",
)
_LOOKS = "KHR_materials_"


class _Part(ForeignDocument, rename="camel", kw_only=True):
    """Base of the document's parts."""


class Asset(_Part):
    """Statements of the file about itself."""

    version: str = "2.0"


class GltfScene(_Part):
    """The roots of a scene's trees of nodes."""

    nodes: list[Count] = field(default_factory=list)


class Node(_Part):
    """A node, placed by a matrix (by columns) or by scale, rotation (x, y, z, w), translation."""

    mesh: Count | None = None
    skin: Count | None = None
    children: list[Count] = field(default_factory=list)
    matrix: Annotated[list[Finite], Meta(min_length=16, max_length=16)] | None = None
    translation: Point3 = (0.0, 0.0, 0.0)
    rotation: _Point4 = (0.0, 0.0, 0.0, 1.0)
    scale: Point3 = (1.0, 1.0, 1.0)


class Primitive(_Part):
    """A part of a mesh with one material; attributes and indices are numbers of accessors."""

    attributes: dict[str, Count]
    indices: Count | None = None
    material: Count | None = None
    mode: int = 4


class GltfMesh(_Part):
    """The primitives of a mesh."""

    primitives: list[Primitive]
    weights: list[Finite] = field(default_factory=list)  # of shapes that it may take


class SparsePart(_Part):
    """Places at which a sparse accessor has values of its own, or these values."""

    buffer_view: Count
    component_type: int = 0  # of the places
    byte_offset: Count = 0


class Sparse(_Part):
    """Values that a sparse accessor changes."""

    count: Count
    indices: SparsePart
    values: SparsePart


class Accessor(_Part):
    """An array in a buffer."""

    count: Count
    component_type: int
    type: str
    buffer_view: Count | None = None
    byte_offset: Count = 0
    normalized: bool = False
    sparse: Sparse | None = None


class BufferView(_Part):
    """A part of a buffer."""

    buffer: Count
    byte_length: Count
    byte_offset: Count = 0
    byte_stride: Count | None = None


class Buffer(_Part):
    """Bytes: a file, data in the text, or the binary part of a GLB file."""

    byte_length: Count
    uri: str | None = None


class Image(_Part):
    """A picture: a file, data in the text, or a part of a buffer."""

    uri: str | None = None
    buffer_view: Count | None = None


class Texture(_Part):
    """The picture of a texture."""

    source: Count | None = None
    extensions: Extensions = field(default_factory=lambda: Extensions())


class TextureTransform(_Part):
    """Change of texture coordinates: scaled, rotated [rad], moved."""

    offset: Point2 = (0.0, 0.0)
    rotation: Finite = 0.0
    scale: Point2 = (1.0, 1.0)
    tex_coord: Count | None = None


class TextureUse(_Part):
    """A texture as a material uses it, with the number of its set of coordinates."""

    index: Count
    tex_coord: Count = 0
    extensions: Extensions = field(default_factory=lambda: Extensions())


class BaseColor(_Part):
    """The base colour of a material, in linear light; an older extension calls it diffuse."""

    base_color_factor: _Point4 | None = None
    base_color_texture: TextureUse | None = None
    diffuse_factor: _Point4 | None = None
    diffuse_texture: TextureUse | None = None


class Extensions(_Part):
    """The extensions that are read: of textures, of their uses, and of materials."""

    webp: Texture | None = field(name="EXT_texture_webp", default=None)
    transform: TextureTransform | None = field(name="KHR_texture_transform", default=None)
    glossiness: BaseColor | None = field(name="KHR_materials_pbrSpecularGlossiness", default=None)


class MaterialPart(_Part):
    """The look of a surface."""

    name: str = ""
    pbr_metallic_roughness: BaseColor = field(default_factory=BaseColor)
    extensions: Extensions = field(default_factory=Extensions)


class GltfDocument(_Part):
    """The whole document."""

    asset: Asset = field(default_factory=Asset)
    scene: Count = 0
    scenes: list[GltfScene] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)
    meshes: list[GltfMesh] = field(default_factory=list)
    accessors: list[Accessor] = field(default_factory=list)
    buffer_views: list[BufferView] = field(default_factory=list)
    buffers: list[Buffer] = field(default_factory=list)
    materials: list[MaterialPart] = field(default_factory=list)
    textures: list[Texture] = field(default_factory=list)
    images: list[Image] = field(default_factory=list)
    extensions_used: list[str] = field(default_factory=list)
    extensions_required: list[str] = field(default_factory=list)


class GltfFile:
    """A glTF file: its document, and the arrays of its buffers, which are read when asked for.

    Errors of arrays name their place in the document; who asks for them names the file. ``size``
    counts the bytes read so far, of the files that it names, too.

    Raises DataError if it is no glTF 2.0 file, cut short, or needs an extension that is not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        data = read_bytes(path)
        self.size = len(data)
        text, self._binary = _chunks(data, path) if data[:4] == b"glTF" else (data, None)
        with reading(path):
            parsed = parse_json(str(text, "utf-8-sig"), str(path))
        with in_file(path):
            self.document: GltfDocument = convert(parsed, GltfDocument)
            _check(self.document)
        self._buffers: dict[int, memoryview] = {}
        self._files: dict[str, bytes] = {}

    def array(self, number: int) -> Array:
        """The array (n, width) of an accessor; of normalized integers as fractions."""
        accessor = nth(self.document.accessors, number, "accessors")
        place = f"accessors[{number}]"
        if accessor.component_type not in _NUMBERS:
            raise damaged(f"componentType {accessor.component_type} is not known", place)
        if accessor.type not in _WIDTHS:
            raise damaged(f"{quote(accessor.type)} are no points or numbers", place)
        dtype, width = np.dtype(_NUMBERS[accessor.component_type]), _WIDTHS[accessor.type]
        if accessor.buffer_view is None:
            if accessor.count > self.size:
                raise damaged(f"{accessor.count} values, but no data", place)
            values = np.zeros((accessor.count, width), dtype=dtype)
        else:
            values = self._values(
                accessor.buffer_view, accessor.byte_offset, (accessor.count, width), dtype
            )
        if accessor.sparse is not None:
            values = self._with_sparse(values, accessor.sparse, place)
        if accessor.normalized and dtype.kind != "f":
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def view(self, number: int) -> memoryview:
        """The bytes of a buffer view."""
        part = nth(self.document.buffer_views, number, "bufferViews")
        data = self._buffer(part.buffer)
        if part.byte_offset + part.byte_length > len(data):
            what = f"it ends after the {len(data)} bytes of its buffer"
            raise damaged(what, f"bufferViews[{number}]")
        return data[part.byte_offset : part.byte_offset + part.byte_length]

    def _values(self, number: int, offset: int, shape: tuple[int, int], dtype: Any) -> Array:
        """An array in a buffer view, which is not copied."""
        data = self.view(number)
        row = shape[1] * dtype.itemsize
        stride = self.document.buffer_views[number].byte_stride or row
        end = offset + (shape[0] - 1) * stride + row if shape[0] else offset
        if stride < row or end > len(data):
            what = f"{shape[0]} values of {row} bytes do not fit into {len(data)} bytes"
            raise damaged(what, f"bufferViews[{number}]")
        strides = (stride, dtype.itemsize)
        return np.ndarray(shape, dtype, buffer=data, offset=offset, strides=strides)

    def _with_sparse(self, values: Array, sparse: Sparse, place: str) -> Array:
        kind = np.dtype(_NUMBERS.get(sparse.indices.component_type, "<f4"))

        def part(of: SparsePart, width: int, dtype: Any) -> Array:
            return self._values(of.buffer_view, of.byte_offset, (sparse.count, width), dtype)

        rows = part(sparse.indices, 1, kind)[:, 0]
        given = part(sparse.values, values.shape[1], values.dtype)
        if kind.kind != "u" or (len(rows) and rows.max() >= len(values)):
            raise damaged("its sparse indices are out of range", place)
        changed = values.copy()
        changed[rows] = given
        return changed

    def _buffer(self, number: int) -> memoryview:
        if number not in self._buffers:
            buffer = nth(self.document.buffers, number, "buffers")
            data = self._read(buffer, number)
            if len(data) < buffer.byte_length:
                what = f"{len(data)} bytes, {buffer.byte_length} announced"
                raise damaged(what, f"buffers[{number}]")
            self._buffers[number] = memoryview(data)[: buffer.byte_length]
        return self._buffers[number]

    def _read(self, buffer: Buffer, number: int) -> bytes:
        if buffer.uri is None:
            if self._binary is None or number:
                raise damaged("it has no data", f"buffers[{number}]")
            return self._binary
        if buffer.uri not in self._files:
            data = embedded(buffer.uri)
            if data is None:
                data = read_bytes(self.path.parent / unquote(buffer.uri))
                self.size += len(data)
            self._files[buffer.uri] = data
        return self._files[buffer.uri]


def nth(parts: Sequence[_T], number: int, name: str) -> _T:
    """The part of a number; raises DataError where there is none."""
    if number >= len(parts):
        what = f"named, but there are {len(parts)} {name}"
        raise damaged(what, f"{name}[{number}]")
    return parts[number]


def embedded(uri: str) -> bytes | None:
    """The data that stand in the text of a ``data:`` URI; None of the name of a file."""
    if not uri.startswith("data:"):
        return None
    form, _, data = uri.partition(",")
    if not form.endswith(";base64"):
        return unquote_to_bytes(data)
    try:
        return base64.b64decode(data)
    except (binascii.Error, ValueError) as error:
        raise damaged(f"not base64 ({brief(error)})", "uri") from None


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """The document of a GLB file, and its binary part."""
    version = int.from_bytes(data[4:8], "little")
    if version != 2:
        raise DataError(f"version {version} of GLB; only version 2 is read", where=str(path))
    found: dict[bytes, bytes] = {}
    place = 12
    while place + 8 <= len(data) and len(found) < 2:
        length, kind = (
            int.from_bytes(data[place : place + 4], "little"),
            data[place + 4 : place + 8],
        )
        if place + 8 + length > len(data):
            raise damaged(f"a part of {length} bytes is cut short", path)
        found.setdefault(kind, data[place + 8 : place + 8 + length])
        place += 8 + length
    if _JSON_CHUNK not in found:
        raise damaged("the GLB file has no JSON", path)
    return found[_JSON_CHUNK], found.get(_BINARY_CHUNK)


def _check(document: GltfDocument) -> None:
    """Refuse other versions, and extensions without which the file means something else."""
    if not document.asset.version.startswith("2."):
        what = f"version {quote(document.asset.version)} of glTF; only version 2 is read"
        raise DataError(what, where="asset")
    unknown = [
        name
        for name in document.extensions_required
        if name not in _EXTENSIONS and not name.startswith(_LOOKS)
    ]
    if unknown:
        raise DataError(
            f"{brief(', '.join(unknown))} is needed to read this file, and not known",
            where="extensionsRequired",
            fix="export it without this extension; of compressed geometry, uncompressed",
        )
