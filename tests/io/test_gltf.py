"""glTF files: what is read, and what is refused before it takes memory or time."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.gltf_files import CORNERS, FACES, POSITIONS, SQUARE, VIEWS, data_uri, write_gltf
from support.timing import reference_seconds, timed

from cadalign.datasets import load_mesh
from cadalign.errors import DataError
from cadalign.geometry.mesh import Mesh
from cadalign.io.meshes.materials import WHITE


def read(tmp_path: Path, **changes: Any) -> Mesh:
    return load_mesh(write_gltf(tmp_path / "a.gltf", **changes))


def refusal(tmp_path: Path, **changes: Any) -> str:
    with pytest.raises(DataError) as caught:
        read(tmp_path, **changes)
    return str(caught.value).replace(str(tmp_path / "a.gltf"), "FILE")


def primitive(**changes: Any) -> list[dict[str, Any]]:
    return [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1} | changes]}]


# --- what is read ------------------------------------------------------------------------------


def test_nodes_are_placed_from_the_root_down(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    nodes = [
        {"translation": [10, 0, 0], "children": [1]},
        {"rotation": [0, 0, half, half], "scale": [2, 3, 1], "mesh": 0, "children": [2]},
        {"matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1], "mesh": 0},
    ]
    mesh = read(tmp_path, nodes=nodes)
    first = np.column_stack([10 - 3 * SQUARE[:, 1], 2 * SQUARE[:, 0], 0 * SQUARE[:, 0]])
    second = first * [1, -1, 1] + [0, 0, 5]
    np.testing.assert_allclose(mesh.vertices, np.concatenate([first, second]), atol=1e-6)
    # The copy is mirrored twice over, by its node: its normals still point along z.
    corners = mesh.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()


def test_colours_of_vertices_without_a_material_are_not_tinted(tmp_path: Path) -> None:
    """Nor are grey surfaces without either made white."""
    colored = read(tmp_path, meshes=primitive(attributes={"POSITION": 0, "COLOR_0": 0}))
    assert colored.vertex_colors is not None
    np.testing.assert_allclose(colored.vertex_colors[:, :2], SQUARE[:, :2])
    assert colored.materials[0].color == WHITE
    plain = read(tmp_path, meshes=primitive())
    assert plain.vertex_colors is None
    assert plain.materials[0].color != WHITE


@pytest.mark.parametrize("mode", [0, 1, 3])
def test_points_and_lines_are_no_faces(tmp_path: Path, mode: int) -> None:
    assert refusal(tmp_path, meshes=primitive(mode=mode)) == (
        "FILE: the file has no faces; is it complete?"
    )


def test_interleaved_and_quantized_values(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [127, 0, 0], [127, 127, 0], [-128, 127, 0]], "<i1")
    more = b"".join(row.tobytes() + b"\0" for row in points)
    views = [*VIEWS, {"buffer": 0, "byteOffset": 60, "byteLength": 16, "byteStride": 4}]
    quantized = {
        "bufferView": 2, "componentType": 5120, "count": 4, "type": "VEC3", "normalized": True,
    }  # fmt: skip
    mesh = read(
        tmp_path,
        more=more,
        bufferViews=views,
        accessors=[quantized, CORNERS],
        extensionsRequired=["KHR_mesh_quantization"],
    )
    np.testing.assert_allclose(mesh.vertices, np.maximum(points / 127, -1))


def test_vertices_that_primitives_share_are_not_repeated(tmp_path: Path) -> None:
    one = {"attributes": {"POSITION": 0}, "indices": 2}
    accessors = [POSITIONS, CORNERS, CORNERS | {"count": 3}]
    mesh = read(tmp_path, accessors=accessors, meshes=[{"primitives": [one, one]}])
    assert len(mesh.vertices) == 6
    np.testing.assert_array_equal(mesh.triangles[1], SQUARE[:3])


# --- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"nodes": [{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}]},
            "nodes[2]: the node has two parents, or is its own ancestor; nodes must form a tree",
        ),
        (
            {"nodes": [{"children": [1]}, {"children": [0], "mesh": 0}]},
            "nodes[0]: the node has two parents, or is its own ancestor; nodes must form a tree",
        ),
        (
            {"extensionsRequired": ["KHR_materials_unlit", "KHR_draco_mesh_compression"]},
            "extensionsRequired: the file requires KHR_draco_mesh_compression, which is not "
            "supported; export it without this extension, such as without compressed geometry",
        ),
        (
            {"meshes": primitive(mode=5)},
            "meshes: triangle strips and fans are not supported; export single triangles",
        ),
        (
            {"asset": {"version": "1.0"}},
            "asset: the file has glTF version '1.0'; only version 2 is supported",
        ),
        (
            {"nodes": [{"mesh": 7}]},
            "cannot be read as a GLTF file (IndexError: list index out of range); the file is cut "
            "short or damaged; get it again",
        ),
        (
            {"nodes": [{"mesh": -1}]},
            "cannot be read as a GLTF file (IndexError: list index out of range); the file is cut "
            "short or damaged; get it again",
        ),
        (
            {"accessors": [POSITIONS | {"count": 5}, CORNERS]},
            "accessors[0]: 5 values of 12 bytes do not fit into 48 bytes; the file is cut short "
            "or damaged; get it again",
        ),
        (
            {"accessors": [POSITIONS | {"sparse": {"count": 1}}, CORNERS]},
            "accessors[0]: sparse accessors, and accessors without data, are not supported; export "
            "the file without them",
        ),
        (
            {"accessors": [POSITIONS, CORNERS | {"count": "many"}]},
            "cannot be read as a GLTF file (TypeError: unsupported operand type(s) for //: 'str' "
            "and 'int'); the file is cut short or damaged; get it again",
        ),
    ],
)  # fmt: skip
def test_files_that_are_wrong_are_refused_by_the_place(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    assert refusal(tmp_path, **changes) == f"FILE: {message}"


def test_optional_extensions_are_ignored(tmp_path: Path) -> None:
    assert len(read(tmp_path, extensionsUsed=["KHR_draco_mesh_compression"]).faces) == 2


def test_invalid_buffers_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for uri, reason in (
        ("pipe", "not a regular file; give a regular file, not a pipe or device"),
        ("/dev/zero", "not a regular file; give a regular file, not a pipe or device"),
        ("nothing.bin", "no such file"),
    ):
        message = refusal(tmp_path, buffers=[{"byteLength": 60, "uri": uri}])
        assert message == f"FILE: {tmp_path / uri}: {reason}"
    short = data_uri(b"short")
    assert "5 bytes in its buffer, 60 announced" in refusal(
        tmp_path, buffers=[{"byteLength": 60, "uri": short}]
    )


def test_meshes_that_nodes_repeat_are_bounded_by_the_file(tmp_path: Path) -> None:
    corners = np.resize(FACES, 30_000).tobytes()
    path = write_gltf(
        tmp_path / "a.gltf",
        more=corners,
        bufferViews=[*VIEWS, {"buffer": 0, "byteOffset": 60, "byteLength": len(corners)}],
        accessors=[POSITIONS, CORNERS | {"bufferView": 2, "count": 30_000}],
        nodes=[{"mesh": 0}] * 6_000,
        scenes=[{"nodes": list(range(6_000))}],
    )
    with pytest.raises(DataError) as caught:
        load_mesh(path)
    assert str(caught.value) == (
        f"{path}: its nodes repeat meshes to 60000000 faces, too many for 60060 bytes; "
        "simplify the meshes, or remove copies"
    )


@pytest.mark.timing
def test_deep_scenes_take_linear_time(tmp_path: Path) -> None:
    count = 100_000
    chain: list[dict[str, Any]] = [
        {"children": [k + 1], "translation": [0, 0, 1e-3]} for k in range(count - 1)
    ]
    path, found = write_gltf(tmp_path / "a.gltf", nodes=[*chain, {"mesh": 0}]), []
    loading = timed(lambda: found.append(load_mesh(path)))
    assert reference_seconds(loading, below=5, rounds=1) < 5
    assert found[0].bounds[0, 2] == pytest.approx((count - 1) * 1e-3)


@pytest.mark.timing
def test_many_materials_take_linear_time(tmp_path: Path) -> None:
    count = 50_000
    (tmp_path / "a.mtl").write_text("".join(f"newmtl m{k}\nKd 1 0 0\n" for k in range(count)))
    faces = "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(count))
    path, found = tmp_path / "a.obj", []
    path.write_text(f"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n{faces}")
    loading = timed(lambda: found.append(load_mesh(path)))
    assert reference_seconds(loading, below=4, rounds=1) < 4
    assert len(found[0].materials) == count
