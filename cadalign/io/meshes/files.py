"""Read mesh files of several formats, check them, and write OBJ and PLY."""

from __future__ import annotations

import os
from codecs import BOM_UTF8
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DataError, brief
from cadalign.geometry.mesh import Mesh, check_near, face_normals, spread_colors
from cadalign.io.documents import name_file
from cadalign.io.files import (
    as_path,
    create_folder,
    damage_error,
    once_per_file,
    protect_input,
    read_bytes,
    write_whole,
)
from cadalign.io.kinds import MESH, refuse_other_file
from cadalign.io.meshes.gltf import read_gltf
from cadalign.io.meshes.polygons import read_obj, read_off, read_ply, read_stl

# ShapeNet's coordinates have 6 decimals; an extent below ten of these steps is rounding.
_FLAT = 1e-5
_DIGITS = 12  # decimals in OBJ files
_FAR = 1000.0  # largest distance of a PLY mesh from the origin [its extent]

_READERS = {
    ".obj": read_obj,
    ".ply": read_ply,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".stl": read_stl,
    ".off": read_off,
}


def load_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh with its faces in file order.

    ``Mesh.polygon`` of OBJ and PLY files holds each triangle's face number in the file, to which
    keypoint annotations refer. The nodes of a GLB or glTF scene are transformed and joined to one
    mesh.

    A missing or unreadable material library or texture causes a warning (logger "cadalign"), and
    the surface becomes plain.

    Parameters
    ----------
    path : str or path-like
        An OBJ, PLY, GLB, glTF, STL or OFF file.

    Returns
    -------
    Mesh
        Its ``source`` is the path.

    Raises
    ------
    DataError
        If the file is missing, empty, cut short, of an unknown format, or has no faces.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "square.obj")
    ...     _ = path.write_text("v 0 0 0\\nv 1 0 0\\nv 1 1 0\\nv 0 1 0\\nf 1 2 3 4\\n")
    ...     mesh = load_mesh(path)
    >>> mesh.faces.tolist(), mesh.polygon.tolist()
    ([[0, 1, 2], [0, 2, 3]], [0, 0])
    """
    path = as_path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None and path.is_dir():
        raise DataError("a folder, not a mesh file", where=str(path), fix="give a file in it")
    if reader is None:
        refuse_other_file(path, MESH)
        raise DataError(
            f"{path.suffix or 'no extension'} is not a known mesh format",
            where=str(path),
            fix=f"known are {', '.join(_READERS)}",
        )
    protect_input(path)
    try:
        data = read_bytes(path)
        if not data:
            raise DataError("the mesh file is empty", where=str(path), fix="get it again")
        with name_file(path), np.errstate(all="ignore"):  # Mesh refuses values that are not finite
            mesh = reader(data.removeprefix(BOM_UTF8), path)
            if not np.linalg.norm(face_normals(mesh.triangles), axis=1).any():
                raise DataError("all faces of the mesh have zero area")
    except Exception as error:  # damaged content can raise any error
        refuse_other_file(path, MESH)
        if isinstance(error, CadalignError):
            raise
        reason = f"{type(error).__name__}: {brief(error)}"
        kind = path.suffix[1:].upper()
        raise damage_error(f"cannot be read as a {kind} file ({reason})", path) from None
    return mesh


def check_keypoints(points_3d: FloatArray, model: Path | None, *, where: str) -> None:
    """Raise an error if keypoints (k, 3) lie far from the mesh in a file; see `check_near`.

    A file that is missing or not a mesh is not checked.
    """
    if model is None or not model.is_file():
        return
    with suppress(DataError):
        bounds = mesh_at(model).bounds
        check_near(points_3d, bounds, where=where)


mesh_at = once_per_file(16)(load_mesh)
"""`load_mesh` with a cache of the last meshes, which objects of a run may share."""


def check_solid(mesh: Mesh) -> None:
    """Refuse a mesh without thickness along an axis: less than 1e-5 of its box's diagonal.

    The stretch of such a model along the axis cannot be estimated, and the overlap of its boxes is
    not defined.

    Raises
    ------
    DataError
        If the mesh is flat; it names the mesh's source and the axes.

    Examples
    --------
    >>> check_solid(Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], source="square.obj"))
    Traceback (most recent call last):
    cadalign.errors.DataError: square.obj: the model has zero thickness along z; leave it out
    """
    extents = np.ptp(mesh.bounds, axis=0)
    is_flat = extents <= _FLAT * np.linalg.norm(extents)
    if is_flat.any():
        names = " and ".join(axis for axis, flat in zip("xyz", is_flat, strict=True) if flat)
        what = f"the model has zero thickness along {names}"
        raise DataError(what, where=mesh.source, fix="leave it out")


def write_mesh(path: Path, mesh: Mesh, *, kind: Literal["obj", "ply"]) -> None:
    """Write a mesh as OBJ or binary PLY, with faces in order and vertex colours.

    A mesh without vertex colours gets the colours of its materials; a texture becomes its mean
    colour. Missing folders are created.

    Raises DataError if the file cannot be written, or the mesh is too far from the origin for PLY.
    """
    import trimesh  # takes time

    extents = np.ptp(mesh.bounds, axis=0)
    if kind == "ply" and np.abs(mesh.bounds).max() > _FAR * extents.max():
        what = f"the mesh lies more than {_FAR:g} times its size from its origin; PLY has 7 digits"
        raise DataError(what, where=str(path), fix="write OBJ, or move the mesh to the origin")
    colors = np.round(255 * spread_colors(mesh, _palette(mesh))).astype(np.uint8)
    written = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    options: dict[str, Any] = {"digits": _DIGITS, "header": None} if kind == "obj" else {}
    data: Any = written.export(file_type=kind, **options)
    content = data.encode() if isinstance(data, str) else data
    create_folder(path.parent)
    write_whole(path, lambda unfinished: unfinished.write_bytes(content))


def _palette(mesh: Mesh) -> FloatArray:
    """Colours (k, 4) of materials; a texture becomes its mean colour."""
    palette = np.array([each.color for each in mesh.materials])
    for row, each in enumerate(mesh.materials):
        if each.texture is not None:
            palette[row, :3] = each.texture[..., :3].reshape(-1, 3).mean(axis=0) / 255
    return palette
