"""GLB with an animation: nodes follow the poses, readers read it."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cadalign.errors import InputError
from cadalign.export.glb import MovingObject, write_moving_glb
from cadalign.geometry.conventions import OPENGL_AXES
from cadalign.geometry.mesh import Material, Mesh
from cadalign.geometry.rotations import rotation_from_vector

FRAMES = 40


def moving(name: str, seed: int) -> MovingObject:
    """A tetrahedron of two materials that turns more than once."""
    rng = np.random.default_rng(seed)
    mesh = Mesh(
        np.vstack([np.zeros(3), np.eye(3)]),
        np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        materials=(Material("a", (1.0, 0.0, 0.0, 1.0)), Material("b")),
        face_material=np.array([0, 0, 1, 1]),
    )
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    poses = [
        [*rotation_from_vector(0.3 * k * axis).ravel(), 0.1 * k, *rng.normal(size=2)]
        for k in range(FRAMES)
    ]
    return MovingObject(name, mesh, np.arange(FRAMES) / 30.0, np.array(poses))


def read(path: Path) -> tuple[dict[str, Any], dict[tuple[str, str], Any]]:
    """The tree, and times and values of each animated node's path."""
    data = path.read_bytes()
    length, kind = struct.unpack("<I4s", data[12:20])
    assert (kind, len(data)) == (b"JSON", struct.unpack("<I", data[8:12])[0])
    tree = json.loads(data[20 : 20 + length])
    buffers = [data[28 + length :]]
    buffers += [base64.b64decode(each["uri"].split(",")[1]) for each in tree["buffers"][1:]]

    def values(accessor: int) -> Any:
        own = tree["accessors"][accessor]
        view = tree["bufferViews"][own["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[own["type"]]
        blob = buffers[view["buffer"]][view["byteOffset"] :][: view["byteLength"]]
        found = np.frombuffer(blob, "<f4").reshape(own["count"], columns)
        np.testing.assert_array_equal(own["min"], found.min(axis=0))
        np.testing.assert_array_equal(own["max"], found.max(axis=0))
        return found

    (animation,) = tree["animations"]
    found = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        assert sampler["interpolation"] == "LINEAR"
        node = tree["nodes"][channel["target"]["node"]]["name"]
        keyframes = values(sampler["input"])[:, 0], values(sampler["output"])
        found[node, channel["target"]["path"]] = keyframes
    return tree, found


def test_nodes_follow_the_poses(tmp_path: Path) -> None:
    # Names that trimesh takes itself, or that a part of another object has.
    objects = [moving("car", 0), moving("car_0", 1), moving("world", 2)]
    write_moving_glb(tmp_path / "tracks.glb", objects)
    _, found = read(tmp_path / "tracks.glb")
    assert len(found) == 6
    for each in objects:
        (times, places), (_, quaternions) = (
            found[each.name, p] for p in ("translation", "rotation")
        )
        np.testing.assert_allclose(times, each.times, rtol=1e-6)
        points = each.mesh.vertices
        for k, pose in enumerate(each.poses):
            turn = trimesh.transformations.quaternion_matrix(np.roll(quaternions[k], 1))[:3, :3]
            placed = points @ turn.T + places[k]
            expected = (points @ pose[:9].reshape(3, 3).T + pose[9:]) * OPENGL_AXES
            np.testing.assert_allclose(placed, expected, atol=1e-5)
        # Between keyframes viewers take the short way.
        assert ((quaternions[1:] * quaternions[:-1]).sum(axis=1) > 0.9).all()


def test_trimesh_reads_the_first_frame(tmp_path: Path) -> None:
    each = moving("thing", 3)
    write_moving_glb(tmp_path / "tracks.glb", [each])
    scene = trimesh.load(tmp_path / "tracks.glb")
    assert isinstance(scene, trimesh.Scene)
    assert len(scene.geometry) == 2
    pose = each.poses[0]
    expected = (each.mesh.vertices @ pose[:9].reshape(3, 3).T + pose[9:]) * OPENGL_AXES
    bounds = np.array([expected.min(axis=0), expected.max(axis=0)])
    np.testing.assert_allclose(scene.bounds, bounds, atol=1e-5)


def test_two_objects_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="2 objects, 1 names"):
        write_moving_glb(tmp_path / "tracks.glb", [moving("a", 0), moving("a", 1)])
