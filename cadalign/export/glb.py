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

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.color import srgb_to_linear

from cadalign.arrays import FloatArray
from cadalign.export.aligned_object import AlignedObject, Frame
from cadalign.export.scene_parts import OPAQUE, MeshPart, PlacedPhoto, parts_of, placed_parts
from cadalign.geometry.mesh import Material
from cadalign.io.files import write_whole

_gltf: Any = trimesh.exchange.gltf  # which has no types
_visual: Any = trimesh.visual
_UNLIT = "KHR_materials_unlit"
_CLAMP_TO_EDGE = 33071  # as OpenGL numbers it


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
    nodes: list[_Node] = [
        (f"{exported.name}_{number}", part_mesh(part), part_material(part), placing)
        for number, part in enumerate(parts_of(mesh))
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
        set_materials(tree, {str(row): material for row, (_, _, material, _) in enumerate(nodes)})
        _set_names(tree, {str(row): name for row, (name, *_) in enumerate(nodes)})
        _add_cameras(tree, photos)

    _write(path, scene, complete)


def _set_names(tree: dict[str, Any], names: dict[str, str]) -> None:
    """Give nodes and meshes their names: of those of users trimesh changes some that are equal."""
    for each in (*tree["nodes"], *tree["meshes"]):
        each["name"] = names.get(each["name"], each["name"])


def _write(path: Path, scene: Any, complete: Callable[[dict[str, Any]], None]) -> None:
    data = _gltf.export_glb(scene, include_normals=False, tree_postprocessor=complete)
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))


def part_mesh(part: MeshPart) -> trimesh.Trimesh:
    """The triangles of one material as trimesh writes them."""
    if part.uv is not None:
        return _textured(part.vertices, part.faces, part.uv, part.material.texture)
    colors = None
    if part.colors is not None:
        linear = np.column_stack([srgb_to_linear(part.colors[:, :3]), part.colors[:, 3]])
        colors = np.round(255 * linear).astype(np.uint8)
    return trimesh.Trimesh(part.vertices, part.faces, vertex_colors=colors, process=False)


def _textured(vertices: FloatArray, faces: Any, uv: FloatArray, texture: Any) -> trimesh.Trimesh:
    material = _visual.material.PBRMaterial(baseColorTexture=Image.fromarray(texture))
    visual = _visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def _photo_node(name: str, photo: PlacedPhoto) -> _Node:
    mesh = _textured(*photo.plane.rectangle(photo.depth), photo.plane.image)
    material = {
        "name": name,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {_UNLIT: {}},
    }
    return name, mesh, material, photo.pose


def part_material(part: MeshPart) -> dict[str, Any]:
    """The material of a part as glTF has it."""
    material: Material = part.material
    red, green, blue, alpha = material.color
    linear = srgb_to_linear(np.array([red, green, blue])).tolist()
    look: dict[str, Any] = {
        "name": material.name or "surface",
        "pbrMetallicRoughness": {
            "baseColorFactor": [*linear, alpha],
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "doubleSided": True,  # faces of CAD models point either way
    }
    if alpha < OPAQUE:
        look["alphaMode"] = "BLEND"
    elif part.is_cut_out:
        look["alphaMode"] = "MASK"
    return look


def set_materials(tree: dict[str, Any], looks: dict[str, dict[str, Any]]) -> None:
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
        near, far = photo.clipping
        plane = photo.plane
        look = {"aspectRatio": plane.aspect, "yfov": plane.yfov, "znear": near, "zfar": far}
        tree["cameras"].append({"name": name, "type": "perspective", "perspective": look})
        roots.append(len(tree["nodes"]))
        matrix = photo.pose.T.ravel().tolist()
        tree["nodes"].append({"name": name, "camera": number, "matrix": matrix})
