"""The scene of a glTF file as one mesh."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DataError
from cadalign.geometry.mesh import GREY, Material, Mesh, join
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.io.documents import in_file
from cadalign.io.files import damaged
from cadalign.io.meshes.gltf import (
    BaseColor,
    GltfFile,
    Node,
    Primitive,
    TextureTransform,
    TextureUse,
    embedded,
    nth,
)
from cadalign.io.meshes.materials import WHITE, Texture, Textures

logger = logging.getLogger("cadalign")

_INSTANCES = "EXT_mesh_gpu_instancing"
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# A node of some 20 bytes repeats a whole mesh: what all take together is bounded by the file.
_FREE_BYTES, _EXPANSION = 2**27, 64
_VERTEX_BYTES, _FACE_BYTES = 24 + 32, 24 + 48 + 8 + 8  # colours, texture coordinates included


# A material, and how its texture is used.
_Look = tuple[Material, TextureUse | None]


def read_gltf(path: Path) -> Mesh:
    """Read a glTF or GLB file as one mesh, each node placed by its transform.

    `cadalign.load_mesh` is the public way to it.

    Raises DataError if it is no glTF 2.0 file or damaged, has no faces, is no tree of nodes, needs
    an extension that is not read, or repeats its meshes to more than 128 MB and 64 times its bytes.
    """
    file = GltfFile(path)
    with in_file(path), np.errstate(all="ignore"):  # what is not finite, Mesh refuses
        placed: dict[int, list[FloatArray]] = {}
        for number, transform in _placements(file):
            placed.setdefault(number, []).append(transform)
        primitives = [
            (primitive, np.stack(at))
            for number, at in placed.items()
            for primitive in nth(file.document.meshes, number, "meshes").primitives
            if _count_faces(file, primitive)
        ]
        if not primitives:
            raise DataError("the file has no faces", fix="is it whole?")
        _check_size(file, primitives)
        _warn_of_what_moves(file)
        looks = _Looks(file)
        pieces = [
            _copies(_surface(file, primitive, looks.of(primitive.material)), transforms)
            for primitive, transforms in primitives
        ]
        return join(pieces, str(path))


def _warn_of_what_moves(file: GltfFile) -> None:
    """Say what places vertices elsewhere in viewers, and is not read."""
    document = file.document
    left_out = [
        name
        for name, is_there in (
            ("skins", any(node.skin is not None for node in document.nodes)),
            ("morph targets", any(any(mesh.weights) for mesh in document.meshes)),
            (_INSTANCES, _INSTANCES in document.extensions_used),
        )
        if is_there
    ]
    if left_out:
        said = (
            "%s: not read are %s, by which its vertices lie elsewhere; export it with these applied"
        )
        logger.warning(said, file.path, " and ".join(left_out))


def _placements(file: GltfFile) -> Iterator[tuple[int, FloatArray]]:
    """Meshes and their transforms, in the order of the nodes from the scene's roots down."""
    document = file.document
    if document.scenes:
        roots = nth(document.scenes, document.scene, "scenes").nodes
    else:  # a library of parts; shown are all
        children = {child for node in document.nodes for child in node.children}
        roots = [number for number in range(len(document.nodes)) if number not in children]
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        number, parent = waiting.pop()
        if number in seen:
            what = "the node has two parents, or is its own ancestor"
            raise DataError(what, where=f"nodes[{number}]", fix="the nodes of a scene are a tree")
        seen.add(number)
        node = nth(document.nodes, number, "nodes")
        transform = parent @ _local(node)
        if node.mesh is not None:
            yield node.mesh, transform
        waiting += [(child, transform) for child in reversed(node.children)]


def _local(node: Node) -> FloatArray:
    """A node's transform (4, 4) in its parent's frame."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    transform = np.eye(4)
    x, y, z, w = node.rotation
    if x or y or z:
        transform[:3, :3] = rotation_from_quat_wxyz(np.array([w, x, y, z]))
    transform[:3, :3] *= node.scale
    transform[:3, 3] = node.translation
    return transform


def _count_faces(file: GltfFile, primitive: Primitive) -> int:
    """The number of a primitive's triangles; 0 of points and lines."""
    number = (
        primitive.attributes.get("POSITION") if primitive.indices is None else primitive.indices
    )
    if number is None or "POSITION" not in primitive.attributes:
        return 0
    count = nth(file.document.accessors, number, "accessors").count
    if primitive.mode == _TRIANGLES:
        return count // 3
    return max(count - 2, 0) if primitive.mode in (_STRIP, _FAN) else 0


def _check_size(file: GltfFile, primitives: list[tuple[Primitive, FloatArray]]) -> None:
    """Refuse a scene that repeats its meshes to far more than its file."""
    vertices = faces = 0
    for each, at in primitives:
        count = _count_faces(file, each)
        faces += len(at) * count
        # Many primitives may share one array; files that are named count as well.
        vertices += len(at) * min(len(file.array(each.attributes["POSITION"])), 3 * count)
    size = _VERTEX_BYTES * vertices + _FACE_BYTES * faces
    if size > _FREE_BYTES + _EXPANSION * file.size:
        what = f"its nodes repeat meshes to {faces} faces, from {file.size} bytes"
        raise DataError(what, fix="simplify it, or leave copies out")


class _Looks:
    """The materials of a file, each made once."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._textures = Textures()
        self._images: dict[int, Texture | None] = {}
        self._looks: dict[int | None, _Look] = {None: (Material(), None)}

    def of(self, number: int | None) -> _Look:
        if number not in self._looks:
            self._looks[number] = self._make(int(number or 0))
        return self._looks[number]

    def _make(self, number: int) -> _Look:
        part = nth(self._file.document.materials, number, "materials")
        metallic, older = part.pbr_metallic_roughness, part.extensions.glossiness or BaseColor()
        factor = metallic.base_color_factor or older.diffuse_factor
        use = metallic.base_color_texture or older.diffuse_texture
        texture = None if use is None else self._texture(use.index)
        color = GREY if texture is None else WHITE
        if factor is not None:
            red, green, blue, opacity = encoded(np.clip(factor, 0, 1)).tolist()
            color = (red, green, blue, opacity)
        return Material(part.name, color, texture), None if texture is None else use

    def _texture(self, number: int) -> Texture | None:
        part = nth(self._file.document.textures, number, "textures")
        webp = part.extensions.webp
        source = part.source if webp is None or webp.source is None else webp.source
        if source is None:
            return None
        if source not in self._images:
            self._images[source] = self._read(source)
        return self._images[source]

    def _read(self, number: int) -> Texture | None:
        image, path = nth(self._file.document.images, number, "images"), self._file.path
        name = f"images[{number}]"
        if image.buffer_view is not None:
            data = bytes(self._file.view(image.buffer_view))
            return self._textures.decode(data, within=path, name=name)
        if image.uri is None:
            return None
        content = embedded(image.uri)
        if content is not None:
            return self._textures.decode(content, within=path, name=name)
        return self._textures.read(path, unquote(image.uri))


def _surface(file: GltfFile, primitive: Primitive, look: _Look) -> Mesh:
    """The mesh of a primitive in its own frame."""
    material, use = look
    vertices = _columns(file, primitive, "POSITION", 3)
    corners = np.arange(len(vertices))
    if primitive.indices is not None:
        corners = file.array(primitive.indices)[:, 0].astype(np.int64)
    faces = _triangles(corners, primitive.mode)
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        what = f"a face names vertex {faces.max()}, but there are {len(vertices)}"
        raise damaged(what, f"accessors[{primitive.indices}]")
    uv, colors = _texture_coordinates(file, primitive, use), _colors(file, primitive)
    if len(vertices) > faces.size:  # they are shared with other primitives
        kept, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[kept], faces.reshape(-1, 3)
        uv, colors = (None if each is None else each[kept] for each in (uv, colors))
    if primitive.material is None and colors is not None:
        material = Material(color=WHITE)
    return Mesh(
        vertices,
        faces,
        vertex_colors=colors,
        corner_uv=None if uv is None else uv[faces],
        materials=(material,),
    )


def _columns(file: GltfFile, primitive: Primitive, name: str, width: int) -> FloatArray:
    """An attribute of the vertices (n, width)."""
    number = primitive.attributes[name]
    values = file.array(number)
    if values.shape[1] != width:
        raise damaged(f"{values.shape[1]} numbers for each {name}", f"accessors[{number}]")
    return values.astype(np.float64)


def _triangles(corners: IntArray, mode: int) -> IntArray:
    """The triangles (m, 3) of a list of triangles, a strip or a fan."""
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    first = np.arange(len(corners) - 2)
    if mode == _FAN:
        rows = np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1)
    else:
        odd = first % 2
        rows = np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)
    return corners[rows]


def _texture_coordinates(
    file: GltfFile, primitive: Primitive, use: TextureUse | None
) -> FloatArray | None:
    """Texture coordinates (n, 2) from the bottom left, which glTF has from the top left."""
    if use is None:
        return None
    change = use.extensions.transform or TextureTransform()
    chosen = use.tex_coord if change.tex_coord is None else change.tex_coord
    name = f"TEXCOORD_{chosen}"
    if name not in primitive.attributes:
        return None
    uv = _columns(file, primitive, name, 2)
    _check_count(uv, file, primitive, name)
    cos, sin = np.cos(change.rotation), np.sin(change.rotation)
    turned = uv * change.scale @ np.array([[cos, -sin], [sin, cos]]) + change.offset
    return np.stack([turned[:, 0], 1 - turned[:, 1]], axis=1)


def _colors(file: GltfFile, primitive: Primitive) -> FloatArray | None:
    """Vertex colours (n, 4), sRGB from 0 to 1."""
    number = primitive.attributes.get("COLOR_0")
    if number is None:
        return None
    values = file.array(number)
    if values.dtype.kind in "ui":  # of exporters that leave out that they are normalized
        values = values / np.iinfo(values.dtype).max
    _check_count(values, file, primitive, "COLOR_0")
    colors = np.ones((len(values), 4))
    colors[:, : values.shape[1]] = np.nan_to_num(np.clip(values, 0, 1))
    return encoded(colors)


def _check_count(values: FloatArray, file: GltfFile, primitive: Primitive, name: str) -> None:
    positions = file.document.accessors[primitive.attributes["POSITION"]].count
    if len(values) != positions:
        what = f"{len(values)} values of {name} for {positions} vertices"
        raise damaged(what, f"accessors[{primitive.attributes[name]}]")


def encoded(colors: FloatArray) -> FloatArray:
    """glTF's factors and vertex colours (..., 4), which are linear light, as sRGB."""
    light = colors[..., :3]
    bright = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    found = np.array(colors, dtype=np.float64)
    found[..., :3] = np.where(light <= 0.0031308, 12.92 * light, bright)
    return found


def _copies(mesh: Mesh, transforms: FloatArray) -> Mesh:
    """A mesh with a copy of it at each transform (k, 4, 4)."""
    linear, moved = transforms[:, :3, :3], transforms[:, None, :3, 3]
    vertices = mesh.vertices @ linear.transpose(0, 2, 1) + moved
    starts = len(mesh.vertices) * np.arange(len(transforms))
    faces = mesh.faces + starts[:, None, None]
    uv = None if mesh.corner_uv is None else np.tile(mesh.corner_uv, (len(transforms), 1, 1, 1))
    # Those of a mirrored node are turned round, so that their normals still point outwards.
    mirrored = np.linalg.det(linear) < 0
    faces[mirrored] = faces[mirrored, :, ::-1]
    if uv is not None:
        uv[mirrored] = uv[mirrored, :, ::-1]
    colors = mesh.vertex_colors
    return Mesh(
        vertices.reshape(-1, 3),
        faces.reshape(-1, 3),
        vertex_colors=None if colors is None else np.tile(colors, (len(transforms), 1)),
        corner_uv=None if uv is None else uv.reshape(-1, 3, 2),
        materials=mesh.materials,
    )
