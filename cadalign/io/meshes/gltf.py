"""glTF 2.0 files, text or binary: the document, and the arrays in its buffers.

After the Khronos Group's specification of glTF 2.0. `cadalign.io.meshes.gltf_scene` makes a mesh of
them.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
import numpy.typing as npt

from cadalign.errors import DataError, brief, quote
from cadalign.io.documents import convert, in_file, parse_json
from cadalign.io.files import damaged, read_bytes, reading
from cadalign.io.meshes.gltf_document import Accessor, Buffer, GltfDocument, Sparse

Array = npt.NDArray[Any]
_T = TypeVar("_T")

_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# What they add is read here, or is nothing but the look of surfaces and their light.
_EXTENSIONS = frozenset(
    (
        "EXT_texture_webp",
        "KHR_lights_punctual",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
        "KHR_xmp_json_ld",
    )
)
_LOOKS = "KHR_materials_"


class GltfFile:
    """A glTF file: its document, and the arrays of its buffers, which are read when asked for.

    Errors of arrays name their place in the document; who asks for them names the file.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    document : GltfDocument
    size : int
        The bytes read so far, of the files that it names, too.

    Raises
    ------
    DataError
        If it is no glTF 2.0 file, is cut short, or needs an extension that is not read.
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
        dtype, width = _form(accessor, place)
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
        return _fractions(values) if accessor.normalized else values

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
        """A copy of the values with some replaced."""
        kind = _NUMBERS.get(sparse.indices.component_type, "<f4")
        rows = self._values(
            sparse.indices.buffer_view,
            sparse.indices.byte_offset,
            (sparse.count, 1),
            np.dtype(kind),
        )[:, 0]
        shape = (sparse.count, values.shape[1])
        given = self._values(
            sparse.values.buffer_view, sparse.values.byte_offset, shape, values.dtype
        )
        if kind[1] != "u" or (len(rows) and rows.max() >= len(values)):
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


def _form(accessor: Accessor, place: str) -> tuple[Any, int]:
    """The type and the number of a value's components."""
    if accessor.component_type not in _NUMBERS:
        raise damaged(f"componentType {accessor.component_type} is not known", place)
    if accessor.type not in _WIDTHS:
        raise damaged(f"{quote(accessor.type)} are no points or numbers", place)
    return np.dtype(_NUMBERS[accessor.component_type]), _WIDTHS[accessor.type]


def _fractions(values: Array) -> Array:
    """Integers as fractions of the largest one."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
