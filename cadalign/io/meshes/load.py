"""Mesh files of several formats, and checks of what is in them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from cadalign.errors import DataError, InputError
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import as_path
from cadalign.io.meshes.gltf_scene import read_gltf
from cadalign.io.meshes.obj import read_obj


def _read_by_trimesh(path: Path) -> Mesh:
    # Only here: trimesh takes longer to import than an OBJ file to be read.
    from cadalign.io.meshes.trimesh_files import read_ply, read_solids

    return read_ply(path) if path.suffix.lower() == ".ply" else read_solids(path)


_READERS = {
    ".obj": read_obj,
    ".ply": _read_by_trimesh,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".stl": _read_by_trimesh,
    ".off": _read_by_trimesh,
}
# Coordinates in ShapeNet's files have 6 decimals; less than ten of these steps is rounding.
FLAT_TOLERANCE = 1e-5


def load_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh with its faces in file order.

    ``Mesh.polygon`` of OBJ and PLY files holds each triangle's face number in the file, which is
    what keypoint annotations refer to. In GLB and glTF scenes every node is placed by its
    transform and all become one mesh.

    A material library or texture that is missing or unreadable is warned of (logger "cadalign"),
    and the surface becomes plain.

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
        If the file is missing, empty, cut short, of an unknown or another format, or has no faces.

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
        raise DataError(
            f"{path.suffix or 'no extension'} is not a known mesh format",
            where=str(path),
            fix=f"known are {', '.join(_READERS)}",
        )
    try:
        if not path.stat().st_size and path.is_file():
            raise DataError("the mesh file is empty", where=str(path), fix="get it again")
        return reader(path)
    except InputError as error:  # what Mesh refuses
        where = str(path) if error.where is None else error.where
        raise DataError(error.what, where=where, fix=error.fix) from None
    except FileNotFoundError:
        raise DataError("no such mesh file", where=str(path)) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"the mesh file cannot be read ({reason})", where=str(path)) from None


def as_mesh(given: object, *, where: str) -> Mesh:
    """A mesh, or the one that a path names.

    Raises InputError if it is neither, DataError if the file cannot be read.
    """
    if isinstance(given, Mesh):
        return given
    if isinstance(given, str | os.PathLike):
        return load_mesh(given)
    what = f"expected a cadalign.Mesh or a path, got {type(given).__name__}"
    raise InputError(what, where=where, fix="read it with cadalign.load_mesh")


def flat_axes(mesh: Mesh, *, tolerance: float = FLAT_TOLERANCE) -> tuple[str, ...]:
    """Name the axes along which a mesh has no thickness.

    Such a model has no volume, no stretch along that axis can be told, and boxes around it have no
    overlap to measure.

    Parameters
    ----------
    mesh : Mesh
        The model.
    tolerance : float
        The thickness that counts as none, as a share of the bounding box's diagonal.

    Returns
    -------
    tuple of str
        Some of "x", "y", "z"; empty for a solid model.

    Examples
    --------
    >>> square = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> flat_axes(square)
    ('z',)
    """
    low, high = mesh.bounds
    extents = np.asarray(high - low)
    flat = extents <= tolerance * np.linalg.norm(extents)
    return tuple(axis for axis, thin in zip("xyz", flat, strict=True) if thin)


def check_solid(mesh: Mesh, *, tolerance: float = FLAT_TOLERANCE) -> None:
    """Refuse a mesh that has no thickness along an axis; see `flat_axes`.

    Raises
    ------
    DataError
        Naming the mesh's source and the axes.

    Examples
    --------
    >>> check_solid(Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], source="square.obj"))
    Traceback (most recent call last):
    cadalign.errors.DataError: square.obj: the model has zero thickness along z; leave it out
    """
    flat = flat_axes(mesh, tolerance=tolerance)
    if flat:
        raise DataError(
            f"the model has zero thickness along {' and '.join(flat)}",
            where=mesh.source,
            fix="leave it out",
        )
