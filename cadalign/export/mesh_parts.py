"""A mesh cut into parts of one material, with texture coordinates on vertices."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Material, Mesh


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one material.

    Parameters
    ----------
    material : Material
    vertices : (n, 3) float
    faces : (m, 3) int
    uv : (n, 2) float or None
        Texture coordinates from the bottom left, where the material has a texture.
    colors : (n, 4) float or None
        Vertex colours.
    """

    material: Material
    vertices: FloatArray
    faces: IntArray
    uv: FloatArray | None
    colors: FloatArray | None


def parts_of(mesh: Mesh) -> Iterator[MeshPart]:
    """List the parts of a mesh; vertices with several texture coordinates are repeated."""
    for number in np.unique(mesh.face_material):
        material = mesh.materials[number]
        rows = mesh.face_material == number
        corners = mesh.faces[rows].ravel()
        uv = None
        if material.texture is not None and mesh.corner_uv is not None:
            keys = np.column_stack([corners, mesh.corner_uv[rows].reshape(-1, 2)])
            kept, inverse = np.unique(keys, axis=0, return_inverse=True)
            used, uv = kept[:, 0].astype(np.int64), kept[:, 1:]
        else:
            used, inverse = np.unique(corners, return_inverse=True)
        colors = None if mesh.vertex_colors is None else mesh.vertex_colors[used]
        faces = inverse.reshape(-1, 3).astype(np.int64)
        yield MeshPart(material, mesh.vertices[used], faces, uv, colors)
