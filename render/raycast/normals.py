"""Smooth normals for meshes whose faces may be turned either way."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.edges import number_rows

# A point at which more triangles meet than this is left faceted: pairs grow with the square.
_MAX_VALENCE = 1024
_PAIRS_AT_ONCE = 1 << 20


def corner_normals(
    vertices: FloatArray, faces: IntArray, face_normals: FloatArray, *, crease_angle: float
) -> FloatArray:
    """Average, at each face's corners, the normals of faces that continue it smoothly, (m, 3, 3).

    Faces meet where their vertices have the same position, whether they share the vertex or not.
    Those that are turned the other way count with their normal reversed, since the faces of many
    CAD models are turned at random. Each counts by its angle at the corner. Faces at a larger angle
    than ``crease_angle`` [degrees] meet in an edge. The unit normals are on the side of their face.
    """
    point = number_rows(vertices)[faces].ravel()
    weight = _corner_angles(vertices[faces]).ravel()
    normals = np.repeat(face_normals, 3, axis=0)
    order = np.argsort(point, kind="stable")
    valence = np.bincount(point)
    start = np.cumsum(valence) - valence
    result = normals.copy()
    for count in np.unique(valence):
        if count < 2 or count > _MAX_VALENCE:  # no face uses a point of valence 0
            continue
        first = start[valence == count]
        step = max(1, _PAIRS_AT_ONCE // int(count) ** 2)
        for begin in range(0, len(first), step):
            corners = order[first[begin : begin + step, None] + np.arange(count)]
            result[corners] = _smooth(normals[corners], weight[corners], crease_angle)
    return result.reshape(-1, 3, 3)


def _smooth(normals: FloatArray, weight: FloatArray, crease_angle: float) -> FloatArray:
    """Average within groups of corners (g, c, 3) that share a point."""
    cosine = normals @ normals.transpose(0, 2, 1)
    share = np.where(
        np.abs(cosine) >= np.cos(np.radians(crease_angle)), np.sign(cosine) * weight[:, None, :], 0
    )
    total = share @ normals
    length = np.linalg.norm(total, axis=2, keepdims=True)
    return np.where(length > 1e-9, total / np.where(length > 0, length, 1.0), normals)


def _corner_angles(triangles: FloatArray) -> FloatArray:
    """The angles at the corners of triangles (m, 3, 3); (m, 3) radians."""
    after = np.roll(triangles, -1, axis=1) - triangles
    before = np.roll(triangles, 1, axis=1) - triangles
    scale = np.linalg.norm(after, axis=2) * np.linalg.norm(before, axis=2)
    cosine = np.einsum("mck,mck->mc", after, before) / np.where(scale > 0, scale, 1.0)
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))
