"""GLB (binary glTF 2.0): the textured model, the cameras, and behind it the photos.

The scene's axes are those of the chosen frame; the first camera's are turned to glTF's, so that it
stands in the origin, looks along -z and has y up. Lengths are metres, by `AlignedObject.metres`.
The model is a node whose transform holds pose and stretch. Every view is a camera node with the
photo's field of view, see `cadalign.export.scene_parts`, and a rectangle with the photo behind the
object, seen from its camera's side only and unlit (KHR_materials_unlit).

Buffers, accessors and images are trimesh's. Cameras and materials are written here: trimesh has one
camera, whose aspect ratio is that of angles, no unlit materials, and colours of 8 bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.color import srgb_to_linear

from cadalign.arrays import FloatArray
from cadalign.export.aligned_object import AlignedObject, Frame
from cadalign.export.scene_parts import PlacedPhoto, placed_parts
from cadalign.geometry.mesh import Material, Mesh
from cadalign.io.files import write_whole

_gltf: Any = trimesh.exchange.gltf  # which has no types
_visual: Any = trimesh.visual
_UNLIT = "KHR_materials_unlit"
_CLAMP_TO_EDGE = 33071  # as OpenGL numbers it
_OPAQUE = 0.999  # least opacity of what is drawn as opaque
_WHITE = (1.0, 1.0, 1.0, 1.0)


_Node = tuple[str, trimesh.Trimesh, dict[str, Any], FloatArray]
"""Name, mesh, material and place in the scene."""


def write_glb(path: Path, exported: AlignedObject, *, frame: Frame = "camera") -> None:
    """Write an aligned object with its cameras and photos as GLB.

    Raises
    ------
    InputError
        If there is no mesh, or the frame is not known.
    DataError
        If a photo cannot be read.
    """
    mesh, placing, photos = placed_parts(exported, frame)
    nodes = [
        (f"{exported.name}_{number}", surface, material, placing)
        for number, (surface, material) in enumerate(_parts(mesh))
    ]
    nodes += [
        _photo_node(f"photo_{number}", photo)
        for number, photo in enumerate(photos)
        if photo.plane.image is not None
    ]
    scene = trimesh.Scene()
    for number, (_, surface, _, place) in enumerate(nodes):
        own = str(number)
        scene.add_geometry(surface, geom_name=own, node_name=own, transform=place)

    def complete(tree: dict[str, Any]) -> None:
        _set_materials(tree, {str(row): material for row, (_, _, material, _) in enumerate(nodes)})
        _set_names(tree, {str(row): name for row, (name, *_) in enumerate(nodes)})
        _add_cameras(tree, photos)

    data = _gltf.export_glb(scene, include_normals=False, tree_postprocessor=complete)
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))


def _set_names(tree: dict[str, Any], names: dict[str, str]) -> None:
    """Give nodes and meshes their names: of those of users trimesh changes some that are equal."""
    for each in (*tree["nodes"], *tree["meshes"]):
        each["name"] = names.get(each["name"], each["name"])


def _parts(mesh: Mesh) -> Iterator[tuple[trimesh.Trimesh, dict[str, Any]]]:
    """Parts of one material as trimesh writes them, and their materials as glTF has them.

    Vertices with several texture coordinates are repeated.
    """
    for number in np.unique(mesh.face_material):
        material, rows = mesh.materials[number], mesh.face_material == number
        corners, texture = mesh.faces[rows].ravel(), material.texture
        keys = corners[:, None]
        if texture is not None and mesh.corner_uv is not None:
            keys = np.column_stack([corners, mesh.corner_uv[rows].reshape(-1, 2)])
        kept, inverse = np.unique(keys, axis=0, return_inverse=True)
        used, faces, colors = kept[:, 0].astype(np.int64), inverse.reshape(-1, 3), None
        if mesh.vertex_colors is not None:  # which take the place of the material's
            own, material = mesh.vertex_colors[used], replace(material, color=_WHITE)
            linear = np.column_stack([srgb_to_linear(own[:, :3]), own[:, 3]])
            colors = np.round(255 * linear).astype(np.uint8)
        look = _look(material)
        if texture is not None and mesh.corner_uv is not None:
            surface = _textured(mesh.vertices[used], faces, kept[:, 1:], texture)
            if texture.shape[2] == 4 and (texture[..., 3] < 255).any() and "alphaMode" not in look:
                look["alphaMode"] = "MASK"
        else:
            surface = trimesh.Trimesh(
                mesh.vertices[used], faces, vertex_colors=colors, process=False
            )
        yield surface, look


def _textured(vertices: FloatArray, faces: Any, uv: FloatArray, texture: Any) -> trimesh.Trimesh:
    material = _visual.material.PBRMaterial(baseColorTexture=Image.fromarray(texture))
    visual = _visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def _photo_node(name: str, photo: PlacedPhoto) -> _Node:
    uv = np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    mesh = _textured(photo.corners, np.array([[0, 1, 2], [0, 2, 3]]), uv, photo.plane.image)
    material = {
        "name": name,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {_UNLIT: {}},
    }
    return name, mesh, material, photo.pose


def _look(material: Material) -> dict[str, Any]:
    """A material as glTF has it."""
    red, green, blue, alpha = material.color
    look: dict[str, Any] = {
        "name": material.name or "surface",
        "pbrMetallicRoughness": {
            "baseColorFactor": [*srgb_to_linear(np.array([red, green, blue])).tolist(), alpha],
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "doubleSided": True,  # faces of CAD models point either way
    }
    return look | ({"alphaMode": "BLEND"} if alpha < _OPAQUE else {})


def _set_materials(tree: dict[str, Any], looks: dict[str, dict[str, Any]]) -> None:
    """Replace trimesh's materials, which only bring the textures along."""
    brought = tree.get("materials", [])
    tree["materials"] = []
    for mesh in tree["meshes"]:
        look = looks[mesh["name"]]
        for primitive in mesh["primitives"]:
            surface = dict(look["pbrMetallicRoughness"])
            if "material" in primitive:
                old = brought[primitive["material"]].get("pbrMetallicRoughness", {})
                if "baseColorTexture" in old:
                    surface["baseColorTexture"] = old["baseColorTexture"]
                    if _UNLIT in look.get("extensions", {}):
                        tree["textures"][old["baseColorTexture"]["index"]]["sampler"] = 0
            primitive["material"] = len(tree["materials"])
            tree["materials"].append({**look, "pbrMetallicRoughness": surface})
    if any(_UNLIT in look.get("extensions", {}) for look in looks.values()):
        # By default a texture repeats, and the photo's borders would run into those opposite.
        tree["samplers"] = [{"wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}]
        tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), _UNLIT})


def _add_cameras(tree: dict[str, Any], photos: Sequence[PlacedPhoto]) -> None:
    tree["cameras"] = []
    roots = tree["scenes"][tree["scene"]]["nodes"]
    for number, photo in enumerate(photos):
        name = f"camera_{number}"
        tree["cameras"].append({"name": name, "type": "perspective", "perspective": photo.look})
        roots.append(len(tree["nodes"]))
        matrix = photo.pose.T.ravel().tolist()
        tree["nodes"].append({"name": name, "camera": number, "matrix": matrix})
