"""Mesh files that trimesh reads: PLY with its faces in file order, and whole scenes."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.visual.color import linear_to_srgb

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import CadalignError, DataError
from cadalign.geometry.mesh import GREY, Material, Mesh
from cadalign.io.files import damaged
from cadalign.io.meshes.mtl import WHITE, Texture, texture_array
from cadalign.io.meshes.obj import fan_triangles

_MAX_HEADER_LINES = 1000


def read_ply(path: Path) -> Mesh:
    """Read a PLY file, ASCII or binary; `cadalign.datasets.load_mesh` is the public way to it."""
    with _parsing(path):
        declared = _declared_counts(path)
        if not declared.get("face"):
            raise DataError("the PLY file has no faces", where=str(path))
        mesh = trimesh.load(str(path), process=False)
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.vertices) or mesh.visual is None:
            raise damaged("no triangles could be read", path)
        textured = mesh.visual.kind == "texture"
        if len(mesh.vertices) < declared.get("vertex", 0) and not textured:
            raise _short(path, "vertices", len(mesh.vertices), declared["vertex"])
        if len(mesh.faces) == declared["face"]:
            return _join([_piece(mesh, np.eye(4), path, _textures([mesh], path))], path)
        if textured:
            raise DataError("polygons with texture coordinates are not read", where=str(path))
        return _with_polygons(mesh, declared["face"], path)


def read_scene(path: Path) -> Mesh:
    """Read a GLB, glTF, STL or OFF file as one mesh, each node placed by its transform."""
    with _parsing(path):
        if path.suffix.lower() in (".glb", ".gltf"):
            _check_accessors(path)
        loaded = trimesh.load(str(path), process=False)
        scene = loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)
        textures = _textures(scene.geometry.values(), path)
        pieces = []
        for node in sorted(scene.graph.nodes_geometry):
            transform, name = scene.graph[node]
            geometry = scene.geometry[name]
            if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
                placed = np.asarray(transform, dtype=float)
                pieces.append(_piece(geometry, placed, path, textures))
        if not pieces:
            raise DataError("the file has no faces", where=str(path), fix="is it whole?")
        mesh = _join(pieces, path)
        if path.suffix.lower() == ".off":
            declared = _declared_off_faces(path)
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


def _check_accessors(path: Path) -> None:
    """Refuse glTF accessors without data that are longer than the file: they would be zeros."""
    data = path.read_bytes()
    if data[:4] == b"glTF":
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]  # the chunk of JSON
    for number, accessor in enumerate(json.loads(data).get("accessors", [])):
        if "bufferView" not in accessor and accessor["count"] > path.stat().st_size:
            raise damaged(f"accessor {number} has {accessor['count']} values, but no data", path)


def _textures(geometries: Iterable[Any], path: Path) -> dict[int, Texture]:
    """The textures of all materials by the identity of their image, each converted once."""
    images = [_image(getattr(geometry.visual, "material", None)) for geometry in geometries]
    size = path.stat().st_size
    return {id(image): texture_array(image, size) for image in images if image is not None}


def _image(material: Any) -> Any:
    """The image of one of trimesh's materials; None if it has none."""
    image = getattr(material, "baseColorTexture", None)
    return getattr(material, "image", None) if image is None else image


def _declared_counts(path: Path) -> dict[str, int]:
    """The numbers of elements that a PLY file's header announces."""
    counts: dict[str, int] = {}
    with path.open("rb") as file:
        if file.readline(100).strip().lower() != b"ply":
            raise DataError("not a PLY file", where=str(path), fix="does it begin with 'ply'?")
        for _ in range(_MAX_HEADER_LINES):
            words = file.readline(10_000).split()
            if words == [b"end_header"]:
                return counts
            if len(words) == 3 and words[0] == b"element" and words[2].isdigit():
                counts[words[1].decode("ascii", errors="replace")] = int(words[2])
    raise damaged("the PLY header has no end", path)


def _declared_off_faces(path: Path) -> int:
    """The number of faces that an OFF file's header announces; trimesh doesn't look at it."""
    words: list[bytes] = []
    with path.open("rb") as file:
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


def _piece(
    geometry: Any, transform: FloatArray, path: Path, textures: Mapping[int, Texture]
) -> Mesh:
    """One of trimesh's meshes, placed."""
    vertices = trimesh.transform_points(np.asarray(geometry.vertices, dtype=float), transform)
    faces = np.asarray(geometry.faces, dtype=np.int64)
    visual = geometry.visual
    materials: tuple[Material, ...] = (Material(),)
    face_material = np.zeros(len(faces), dtype=np.int64)
    colors, corner_uv = None, None
    if visual.kind == "texture":
        materials = (_material(visual.material, textures),)
        if visual.uv is not None and len(visual.uv) == len(vertices):
            corner_uv = np.asarray(visual.uv, dtype=float)[faces][:, :, :2]
        attribute = getattr(visual, "vertex_attributes", {}).get("color")
        colors = _unit_colors(attribute, len(vertices))
    elif visual.kind == "vertex":
        materials = (Material(color=WHITE),)
        colors = np.asarray(visual.vertex_colors, dtype=float) / 255
        if path.suffix.lower() in (".glb", ".gltf"):
            colors = _encoded(colors)
    elif visual.kind == "face":
        distinct, face_material = np.unique(visual.face_colors, axis=0, return_inverse=True)
        materials = tuple(Material(color=_rgba(color)) for color in distinct)
    if np.linalg.det(transform[:3, :3]) < 0:
        # A mirrored node: turn the faces round so that their normals still point outwards.
        faces = faces[:, ::-1]
        corner_uv = None if corner_uv is None else corner_uv[:, ::-1]
    return Mesh(
        vertices=vertices,
        faces=faces,
        vertex_colors=colors,
        corner_uv=corner_uv,
        materials=materials,
        face_material=face_material.reshape(-1),
        source=str(path),
    )


def _unit_colors(attribute: Any, count: int) -> FloatArray | None:
    """Vertex colours (n, 4) from 0 to 1 out of a glTF colour attribute."""
    if attribute is None or np.ndim(attribute) != 2 or len(attribute) != count:
        return None
    values = np.asarray(attribute)
    if values.dtype.kind in "ui":
        values = values / np.iinfo(values.dtype).max
    colors = np.ones((count, 4))
    width = min(values.shape[1], 4)
    colors[:, :width] = np.clip(values[:, :width], 0, 1)
    return _encoded(colors)


def _encoded(colors: FloatArray) -> FloatArray:
    """glTF's factors and vertex colours (..., 4), which are linear light, as sRGB."""
    encoded = colors.copy()
    encoded[..., :3] = linear_to_srgb(colors[..., :3])
    return encoded


def _material(material: Any, textures: Mapping[int, Texture]) -> Material:
    """Convert one of trimesh's materials; its colour and texture only."""
    image = _image(material)
    factor = getattr(material, "baseColorFactor", None)
    diffuse = getattr(material, "diffuse", None)
    if factor is not None:
        color = _rgba(_encoded(np.array(_rgba(factor))))
    elif diffuse is not None and getattr(material, "baseColorTexture", None) is None:
        color = _rgba(diffuse)
    else:
        color = GREY if image is None else WHITE
    return Material(
        name=str(getattr(material, "name", None) or ""),
        color=color,
        texture=None if image is None else textures[id(image)],
    )


def _rgba(color: Any) -> tuple[float, float, float, float]:
    values = np.asarray(color)
    scaled = values / 255 if values.dtype.kind in "ui" else values.astype(float)
    red, green, blue, alpha = (float(value) for value in [*scaled, 1.0][:4])
    return red, green, blue, alpha


def _join(pieces: list[Mesh], path: Path) -> Mesh:
    """Put the meshes of a scene together, faces one after the other."""
    vertex_start = np.cumsum([0] + [len(piece.vertices) for piece in pieces])
    material_start = np.cumsum([0] + [len(piece.materials) for piece in pieces])
    colored = any(piece.vertex_colors is not None for piece in pieces)
    textured = any(piece.corner_uv is not None for piece in pieces)
    uv = [
        np.zeros((len(piece.faces), 3, 2)) if piece.corner_uv is None else piece.corner_uv
        for piece in pieces
    ]
    return Mesh(
        vertices=np.concatenate([piece.vertices for piece in pieces]),
        faces=_stack([piece.faces for piece in pieces], vertex_start),
        vertex_colors=np.concatenate([_colors(piece) for piece in pieces]) if colored else None,
        corner_uv=np.concatenate(uv) if textured else None,
        materials=tuple(material for piece in pieces for material in piece.materials),
        face_material=_stack([piece.face_material for piece in pieces], material_start),
        source=str(path),
    )


def _stack(arrays: list[IntArray], starts: IntArray) -> IntArray:
    return np.concatenate([array + start for array, start in zip(arrays, starts, strict=False)])


def _colors(piece: Mesh) -> FloatArray:
    """Vertex colours of a piece among coloured ones: its materials' where it has none."""
    if piece.vertex_colors is not None:
        return piece.vertex_colors
    palette = np.array([material.color for material in piece.materials])
    colors = np.ones((len(piece.vertices), 4))
    colors[piece.faces] = palette[piece.face_material][:, None]
    return colors
