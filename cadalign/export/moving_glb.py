"""GLB with an animation: objects that move before the camera, as tracks tell their motion.

Every object is a node whose translation and rotation follow the keyframes of one animation; the
parts of its mesh are the children. glTF interpolates linearly between keyframes, rotations along
the shortest way. The camera that all poses are in stands in the origin and looks along -z.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.export.glb import part_material, part_mesh, set_materials
from cadalign.export.scene_parts import parts_of
from cadalign.geometry.conventions import OPENGL_AXES
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.files import write_whole

_gltf: Any = trimesh.exchange.gltf  # which has no types
_FLOAT = 5126  # as glTF numbers it


@dataclass(frozen=True, eq=False)
class MovingObject:
    """An object and its motion.

    Parameters
    ----------
    name : str
        Name of its node, other than that of all other objects.
    mesh : Mesh
        Its mesh, stretched.
    times : (P,) float
        Times of its poses [s], increasing, not negative.
    poses : (P, 12) float
        Rotations row by row and translations, in the camera's frame.
    """

    name: str
    mesh: Mesh
    times: FloatArray
    poses: FloatArray

    @property
    def keyframes(self) -> tuple[FloatArray, FloatArray]:
        """Translations (P, 3) and quaternions (P, 4; x, y, z, w) in glTF's axes."""
        turns = OPENGL_AXES[:, None] * self.poses[:, :9].reshape(-1, 3, 3)
        quaternions = np.roll([quat_wxyz_from_rotation(turn) for turn in turns], -1, axis=1)
        # Of the two quaternions of a rotation the one nearer to that of the keyframe before.
        turned = (quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0
        signs = np.cumprod(np.where(turned, -1.0, 1.0))
        quaternions[1:] *= signs[:, None]
        return self.poses[:, 9:] * OPENGL_AXES, quaternions


def write_moving_glb(path: Path, objects: Sequence[MovingObject]) -> None:
    """Write objects that move as GLB with one animation.

    Raises
    ------
    InputError
        If there is no object, or two have one name.
    """
    names = [each.name for each in objects]
    if not names or len(set(names)) < len(names):
        raise InputError(f"{len(names)} objects, {len(set(names))} names", where="objects")
    scene: Any = trimesh.Scene()
    materials = {}
    for each in objects:
        scene.graph.update(frame_to=each.name, matrix=np.eye(4))
        for number, part in enumerate(parts_of(each.mesh)):
            own = f"{each.name}_{number}"
            materials[own] = part_material(part)
            scene.add_geometry(
                part_mesh(part), geom_name=own, node_name=own, parent_node_name=each.name
            )

    def complete(tree: dict[str, Any]) -> None:
        set_materials(tree, materials)
        _animate(tree, objects)

    data = _gltf.export_glb(scene, include_normals=False, tree_postprocessor=complete)
    write_whole(path, lambda unfinished: unfinished.write_bytes(data))


def _animate(tree: dict[str, Any], objects: Sequence[MovingObject]) -> None:
    """Add the keyframes, in a buffer of their own, and the animation that reads them."""
    nodes = {node.get("name"): number for number, node in enumerate(tree["nodes"])}
    arrays: list[FloatArray] = []
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    for each in objects:
        node = tree["nodes"][nodes[each.name]]
        node.pop("matrix", None)
        clock, keyframes = len(arrays), each.keyframes
        arrays += [np.asarray(each.times), *keyframes]
        for offset, (kind, values) in enumerate(
            zip(("translation", "rotation"), keyframes, strict=True), start=1
        ):
            node[kind] = values[0].tolist()
            channels.append(
                {"sampler": len(samplers), "target": {"node": nodes[each.name], "path": kind}}
            )
            samplers.append({"input": clock, "output": clock + offset, "interpolation": "LINEAR"})
    first = _append(tree, arrays)
    samplers = [{**s, "input": s["input"] + first, "output": s["output"] + first} for s in samplers]
    tree["animations"] = [{"name": "tracks", "channels": channels, "samplers": samplers}]


def _append(tree: dict[str, Any], arrays: Sequence[FloatArray]) -> int:
    """Add arrays to the tree; returns the number of the first one's accessor."""
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    first, offset = len(tree["accessors"]), 0
    buffer = len(tree["buffers"])
    blobs = [array.astype("<f4").tobytes() for array in arrays]
    for array, blob in zip(arrays, blobs, strict=True):
        columns = array.astype(np.float32).reshape(len(array), -1)
        tree["accessors"].append(
            {
                "bufferView": len(tree["bufferViews"]),
                "componentType": _FLOAT,
                "count": len(array),
                "type": kinds[columns.shape[1]],
                "min": columns.min(axis=0).tolist(),
                "max": columns.max(axis=0).tolist(),
            }
        )
        view = {"buffer": buffer, "byteOffset": offset, "byteLength": len(blob)}
        tree["bufferViews"].append(view)
        offset += len(blob)
    data = base64.b64encode(b"".join(blobs)).decode("ascii")
    uri = f"data:application/octet-stream;base64,{data}"
    tree["buffers"].append({"byteLength": offset, "uri": uri})
    return first
