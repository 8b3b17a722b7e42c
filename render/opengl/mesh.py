"""A scene's mesh as pyrender's primitives, lit the same on both sides."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyrender

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Material
from cadalign.render.drawing.color import LinearArray, linear_from_srgb
from cadalign.render.raycast.shading import DARKEST
from cadalign.render.raycast.surface import color_channels
from cadalign.render.scene import Scene

_ROUGHNESS = 0.55
# OpenGL's own number; pyrender exports no name for it.
_TRIANGLES = 4


def gl_meshes(scene: Scene) -> tuple[Any, Any]:
    """Make the `pyrender.Mesh` pair of an opaque scene; done once per scene.

    Its shader lights one side of a triangle only. So every triangle is given twice, in one mesh as
    it is and in the other turned round with its normals, and OpenGL culls what is turned away: the
    two sides look alike, as with ray casting. Of triangles that coincide, the one wound towards
    the viewer is kept.
    """
    alike, opposite = scene.coincident_faces
    own = np.arange(len(alike))
    first = alike == own
    sides = (np.flatnonzero(first), np.flatnonzero(first & (opposite == own)))
    return _mesh(scene, sides[0], turned=False), _mesh(scene, sides[1], turned=True)


def _mesh(scene: Scene, faces: IntArray, *, turned: bool) -> Any:
    primitives = []
    for number, material in enumerate(scene.mesh.materials):
        chosen = faces[scene.mesh.face_material[faces] == number]
        if len(chosen):
            primitives.append(_primitive(scene, material, chosen, turned=turned))
    return pyrender.Mesh(primitives=primitives)


def _primitive(scene: Scene, material: Material, faces: IntArray, *, turned: bool) -> Any:
    """Triangles of one material."""
    mesh = scene.mesh
    textured = material.texture is not None and mesh.corner_uv is not None
    factor = np.asarray(material.color, dtype=np.float32)
    factor[:3] = linear_from_srgb(factor[:3])
    attributes: list[FloatArray | LinearArray] = [
        scene.triangles[faces],
        scene.corner_normals[faces] * (-1 if turned else 1),
    ]
    if textured and mesh.corner_uv is not None:
        attributes.append(mesh.corner_uv[faces])
    if mesh.vertex_colors is not None:
        colors = mesh.vertex_colors.astype(np.float32)
        colors[:, :3] = _lifted(linear_from_srgb(colors[:, :3]))
        attributes.append(colors[mesh.faces[faces]])
        # Vertex colours take the place of the material's.
        factor = np.ones(4, dtype=np.float32)
    elif not textured:
        factor[:3] = _lifted(factor[:3])
    rows = [_corners(attribute, turned=turned) for attribute in attributes]
    first, indices = _welded(np.concatenate(rows, axis=1))
    kept = iter(attribute[first] for attribute in rows)
    return pyrender.Primitive(
        positions=next(kept),
        normals=next(kept),
        texcoord_0=next(kept) if textured else None,
        color_0=next(kept) if mesh.vertex_colors is not None else None,
        indices=indices.reshape(-1, 3),
        material=pyrender.MetallicRoughnessMaterial(
            alphaMode="OPAQUE",
            baseColorFactor=factor,
            metallicFactor=0.0,
            roughnessFactor=_ROUGHNESS,
            baseColorTexture=_texture(material.texture) if textured else None,
        ),
        mode=_TRIANGLES,
    )


def _welded(rows: LinearArray) -> tuple[IntArray, IntArray]:
    """First occurrence of each distinct row, and the number of each row among these."""
    packed = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * 4))).ravel()
    _, first, number = np.unique(packed, return_index=True, return_inverse=True)
    # In the order of first use, which graphics cards and their imitations like best.
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[number.ravel()]


def _corners(values: FloatArray | LinearArray, *, turned: bool) -> LinearArray:
    """Values (f, 3, k) of triangles' corners one after the other, (3 f, k) float32."""
    ordered = values[:, ::-1] if turned else values
    return np.ascontiguousarray(ordered.reshape(-1, values.shape[2]), dtype=np.float32)


def _lifted(color: LinearArray) -> LinearArray:
    return np.asarray(DARKEST + (1 - DARKEST) * color, dtype=np.float32)


def _texture(image: npt.NDArray[np.uint8] | None) -> Any:
    """An opaque RGBA texture: rows of other widths than 4 bytes a pixel would be misread."""
    if image is None:
        return None
    rgba = np.full((*image.shape[:2], 4), 255, dtype=np.uint8)
    rgba[:, :, :3] = color_channels(image)
    return pyrender.Texture(source=rgba, source_channels="RGBA")
