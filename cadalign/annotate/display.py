"""Encoding of the displayed model: triangles, normals and colours in one block of bytes."""

from __future__ import annotations

import json

import numpy as np

from cadalign.annotate.model import CadModel
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.simplify import simplify
from cadalign.render.drawing.color import bytes_from_linear
from cadalign.render.raycast.caster import FaceArray
from cadalign.render.scene import Scene

MOST_FACES = 150_000


def display_bytes(model: CadModel, *, max_faces: int = MOST_FACES) -> bytes:
    """Encode the model for display, simplified to at most ``max_faces`` triangles.

    First the length of a JSON header (uint32, little-endian, a multiple of 4 with padding), and the
    header with ``shown`` and ``all``, the numbers of faces; then positions (faces, 3, 3) float32 in
    display coordinates, normals (faces, 3, 3) float32, and sRGB colours (faces, 3) uint8.
    """
    mesh = model.scene.mesh
    small = simplify(mesh, max_faces=max_faces)
    shown = Mesh(model.to_display(small.vertices), small.faces)
    header = json.dumps({"shown": len(small.faces), "all": len(mesh.faces)}).encode()
    header += b" " * (-len(header) % 4)
    weights = np.full((len(small.faces), 3), 1 / 3, dtype=np.float32)
    triangles: FaceArray = small.source.astype(np.int32)
    color = model.scene.surface.color(triangles, weights)
    return b"".join(
        [
            len(header).to_bytes(4, "little"),
            header,
            shown.triangles.astype("<f4").tobytes(),
            Scene(shown).corner_normals.astype("<f4").tobytes(),
            bytes_from_linear(color[:, :3]).tobytes(),
        ]
    )
