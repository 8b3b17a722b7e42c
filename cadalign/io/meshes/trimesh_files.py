"""Mesh files that trimesh reads: PLY with its faces in file order, STL and OFF.

Trimesh gets bytes, never a path: it would open whatever a file names, pictures of any format too.
"""

from __future__ import annotations

import io
import warnings
from codecs import BOM_UTF8
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from cadalign.errors import CadalignError, DataError
from cadalign.geometry.mesh import GREY, Material, Mesh, join
from cadalign.io.files import damaged, read_bytes
from cadalign.io.meshes.materials import WHITE, Texture, Textures
from cadalign.io.meshes.obj import fan_triangles

_MAX_HEADER_LINES = 1000


def read_ply(path: Path) -> Mesh:
    """Read a PLY file, ASCII or binary; `cadalign.load_mesh` is the public way to it."""
    data = read_bytes(path).removeprefix(BOM_UTF8)
    with _parsing(path):
        counts, texture_name = _header(data, path)
        if not counts.get("face"):
            raise DataError("the PLY file has no faces", where=str(path))
        mesh = trimesh.load(io.BytesIO(data), "ply", skip_materials=True, process=False)
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.vertices) or mesh.visual is None:
            raise damaged("no triangles could be read", path)
        textured = mesh.visual.kind == "texture"
        vertices, faces = counts.get("vertex", 0), counts["face"]
        if len(mesh.vertices) < vertices and not textured:
            raise _short(path, "vertices", len(mesh.vertices), vertices)
        if len(mesh.faces) == faces:
            texture = Textures().read(path, texture_name) if textured and texture_name else None
            return _mesh(mesh, path, texture)
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


def _header(data: bytes, path: Path) -> tuple[dict[str, int], str]:
    """Read a PLY file's header: numbers of elements, and the name of a texture or none."""
    file, counts, texture = io.BytesIO(data), dict[str, int](), ""
    if file.readline(100).strip().lower() != b"ply":
        raise DataError("not a PLY file", where=str(path), fix="does it begin with 'ply'?")
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(10_000)
        words = line.split()
        if words == [b"end_header"]:
            return counts, texture
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit():
            counts[words[1].decode("ascii", errors="replace")] = int(words[2])
        if len(words) > 2 and [word.lower() for word in words[:2]] == [b"comment", b"texturefile"]:
            texture = line.split(maxsplit=2)[2].strip().decode("utf-8", errors="replace")
    raise damaged("the PLY header has no end", path)


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
