"""Meshes put together as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Mesh


def join(pieces: list[Mesh], path: Path) -> Mesh:
    """Put the meshes of a file together, faces one after the other."""
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
