"""Meshes as trimesh's, with colours and textures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray

if TYPE_CHECKING:
    from cadalign.geometry.mesh import Material, Mesh

_LEAST_SIDE = 4  # of the part of a texture atlas that one colour takes [px]


def to_trimesh(mesh: Mesh) -> Any:
    """See `Mesh.to_trimesh`."""
    import trimesh

    textured = any(material.texture is not None for material in mesh.materials)
    if textured and mesh.corner_uv is not None:
        return _with_texture(mesh, mesh.corner_uv)
    if mesh.vertex_colors is not None:
        colors: dict[str, Any] = {"vertex_colors": _bytes(mesh.vertex_colors)}
    else:
        of_materials = np.array([material.color for material in mesh.materials])
        colors = {"face_colors": _bytes(of_materials[mesh.face_material])}
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, **colors)


def _with_texture(mesh: Mesh, corner_uv: FloatArray) -> Any:
    """A mesh with three vertices for each face, and one image that holds all materials."""
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    used = np.unique(mesh.face_material)
    atlas, places = _atlas([mesh.materials[number] for number in used])
    uv = corner_uv
    if len(used) > 1:
        # A part of an atlas cannot repeat: coordinates come to lie in [0, 1], once a triangle.
        uv = corner_uv - np.floor(corner_uv.mean(axis=1, keepdims=True))
        left, bottom, width, height = places[np.searchsorted(used, mesh.face_material)].T
        uv = np.clip(uv, 0.0, 1.0) * np.stack([width, height], axis=1)[:, None]
        uv = uv + np.stack([left, bottom], axis=1)[:, None]
    material = PBRMaterial(  # type: ignore[no-untyped-call]
        baseColorTexture=Image.fromarray(atlas),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        alphaMode="BLEND" if atlas[..., 3].min() < 255 else "OPAQUE",
    )
    visuals = TextureVisuals(uv=uv.reshape(-1, 2), material=material)  # type: ignore[no-untyped-call]
    count = 3 * len(mesh.faces)
    return trimesh.Trimesh(
        mesh.vertices[mesh.faces.ravel()],
        np.arange(count).reshape(-1, 3),
        visual=visuals,
        process=False,
    )


def _atlas(materials: list[Material]) -> tuple[npt.NDArray[np.uint8], FloatArray]:
    """Images of materials side by side, RGBA, and their places: left, bottom, width, height.

    Places are texture coordinates, from the bottom left; half a pixel at the borders stays free.
    """
    images = [_image(material) for material in materials]
    height, width = max(len(each) for each in images), sum(each.shape[1] for each in images)
    atlas = np.zeros((height, width, 4), dtype=np.uint8)
    places, left = [], 0
    for image in images:
        rows, columns = image.shape[:2]
        atlas[height - rows :, left : left + columns] = image
        place = (left + 0.5, 0.5, columns - 1, rows - 1)
        places.append(np.array(place) / (width, height, width, height))
        left += columns
    return atlas, np.array(places)


def _image(material: Material) -> npt.NDArray[np.uint8]:
    """The texture times the colour, (h, w, 4)."""
    color = np.array(material.color)
    if material.texture is None:
        return np.broadcast_to(_bytes(color), (_LEAST_SIDE, _LEAST_SIDE, 4)).copy()
    texture = material.texture
    if texture.shape[2] == 3:
        opaque = np.full((*texture.shape[:2], 1), 255, dtype=np.uint8)
        texture = np.concatenate([texture, opaque], axis=2)
    return np.asarray(np.rint(np.clip(texture * np.clip(color, 0, 1), 0, 255)), dtype=np.uint8)


def _bytes(color: FloatArray) -> npt.NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(color, 0, 1)), dtype=np.uint8)
