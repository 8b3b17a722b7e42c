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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.color import srgb_to_linear

from cadalign.arrays import FloatArray
from cadalign.export.aligned_object import AlignedObject, Frame
from cadalign.export.scene_parts import MeshPart, PhotoPlane, parts_of, photo_depth, photo_plane
from cadalign.geometry.conventions import OPENGL_AXES
from cadalign.geometry.mesh import Material
from cadalign.io.files import write_whole

_FLIP = np.diag([*OPENGL_AXES, 1.0])
_NEAR, _FAR = 1e-3, 10.0  # depths between which a viewer draws, over that of the photo
_gltf: Any = trimesh.exchange.gltf  # which has no types
_visual: Any = trimesh.visual
_UNLIT = "KHR_materials_unlit"
_CLAMP_TO_EDGE = 33071  # as OpenGL numbers it
_OPAQUE = 0.999


@dataclass(frozen=True, eq=False)
class _Node:
    """A mesh with its material and place in the scene."""

    name: str
    mesh: trimesh.Trimesh
    material: dict[str, Any]
    transform: FloatArray


@dataclass(frozen=True, eq=False)
class _CameraNode:
    name: str
    camera: dict[str, Any]
    transform: FloatArray


def write_glb(path: Path, exported: AlignedObject, *, frame: Frame = "camera") -> None:
    """Write an aligned object with its cameras and photos as GLB.

    Raises
    ------
    InputError
        If there is no mesh, or the frame is not known.
    DataError
        If a photo cannot be read.
    """
    root = _FLIP if frame == "camera" else np.eye(4)
    nodes, cameras = _model_nodes(exported, root, frame), []
    for number, view in enumerate(exported.views):
        plane = photo_plane(view.camera, view.read_image())
        depth = photo_depth(exported, number) * exported.metres
        pose = root @ exported.frame_from_cam(frame, number) @ _FLIP
        pose[:3, 3] *= exported.metres
        cameras.append(_CameraNode(f"camera_{number}", _camera(plane, depth), pose))
        if plane.image is not None:
            nodes.append(_photo_node(f"photo_{number}", plane, depth, pose))
    scene = trimesh.Scene()
    for node in nodes:
        scene.add_geometry(
            node.mesh, geom_name=node.name, node_name=node.name, transform=node.transform
        )

    def complete(tree: dict[str, Any]) -> None:
        set_materials(tree, {node.name: node.material for node in nodes})
        _add_cameras(tree, cameras)

    data = _gltf.export_glb(scene, include_normals=False, tree_postprocessor=complete)
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))


def _model_nodes(exported: AlignedObject, root: FloatArray, frame: Frame) -> list[_Node]:
    placing = root @ exported.frame_from_model(frame).cam_from_model
    placing[:3] *= exported.metres
    return [
        _Node(f"{exported.name}_{number}", part_mesh(part), part_material(part), placing)
        for number, part in enumerate(parts_of(exported.require_mesh()))
    ]


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


def _photo_node(name: str, plane: PhotoPlane, depth: float, pose: FloatArray) -> _Node:
    vertices = plane.corners * depth * OPENGL_AXES
    uv = np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    mesh = _textured(vertices, np.array([[0, 1, 2], [0, 2, 3]]), uv, plane.image)
    material = {
        "name": name,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {_UNLIT: {}},
    }
    return _Node(name, mesh, material, pose)


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
    texture = material.texture
    is_cut_out = texture is not None and texture.shape[2] == 4 and (texture[..., 3] < 255).any()
    if alpha < _OPAQUE:
        look["alphaMode"] = "BLEND"
    elif is_cut_out:
        look["alphaMode"] = "MASK"
    return look


def _camera(plane: PhotoPlane, depth: float) -> dict[str, Any]:
    return {
        "type": "perspective",
        "perspective": {
            "aspectRatio": plane.aspect,
            "yfov": plane.yfov,
            "znear": _NEAR * depth,
            "zfar": _FAR * depth,
        },
    }


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


def _add_cameras(tree: dict[str, Any], cameras: Sequence[_CameraNode]) -> None:
    tree["cameras"] = [{"name": each.name, **each.camera} for each in cameras]
    roots = tree["scenes"][tree["scene"]]["nodes"]
    for number, each in enumerate(cameras):
        roots.append(len(tree["nodes"]))
        matrix = each.transform.T.ravel().tolist()
        tree["nodes"].append({"name": each.name, "camera": number, "matrix": matrix})
