"""GLB files, read by three.js and trimesh."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from playwright.sync_api import Browser
from support.exported import CAMERA, LENS, POSE, aligned, photo_of, turned
from support.three_viewer import ThreeViewer, three_script

from cadalign import Camera, Mesh
from cadalign.datasets import load_mesh
from cadalign.datasets import open as open_photos
from cadalign.errors import DataError
from cadalign.export import AlignedObject, ExportView, export_object
from cadalign.export.glb import photo_plane
from cadalign.geometry.mesh import Material
from cadalign.render import Scene, cast_geometry

LEAST_IOU = 0.99
FINE = 6  # pixels of the browser's picture per pixel of the photo


@pytest.fixture(scope="module")
def three_code(tmp_path_factory: pytest.TempPathFactory) -> str:
    return three_script(tmp_path_factory.mktemp("three"))


@pytest.fixture(scope="module")
def three(browser: Browser, three_code: str) -> Iterator[ThreeViewer]:
    viewer = ThreeViewer(browser, three_code)
    yield viewer
    assert not viewer.complaints


def tree_of(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    tree: dict[str, Any] = json.loads(data[20 : 20 + length])
    return tree


def agrees(three: ThreeViewer, path: Path, exported: AlignedObject) -> float:
    """IoU of the silhouettes in three.js and in the overlay."""
    view = exported.views[0]
    drawn = three.show(path, part="mask", width=FINE * view.camera.width)
    cast = cast_geometry(Scene(exported.mesh), view.camera, view.cam_from_model)
    mask = drawn.at_pixels(view.camera)[..., 0] > 127
    return float((mask & cast.mask).sum() / (mask | cast.mask).sum())


@pytest.mark.long
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["off-centre", "distorted"])
def test_three_shows_the_object_where_the_overlay_does(
    three: ThreeViewer, tmp_path: Path, camera: Camera
) -> None:
    exported = aligned(tmp_path, camera=camera)
    path = export_object(tmp_path / "wedge.glb", exported)
    assert agrees(three, path, exported) >= LEAST_IOU
    photo = three.show(path, part="photo", width=FINE * camera.width).at_pixels(camera)
    gap = np.abs(photo.astype(int) - photo_of(camera))
    assert gap.mean() < 1.0
    assert np.quantile(gap, 0.999) <= 4
    both = three.show(path, part="all", width=FINE * camera.width).at_pixels(camera)
    mask = cast_geometry(Scene(exported.mesh), camera, POSE).mask
    assert np.abs(both.astype(int) - photo)[~mask].mean() < 1.0  # the photo is behind


@pytest.mark.long
def test_three_agrees_on_real_photos(three: ThreeViewer, tmp_path: Path, real_data: Path) -> None:
    photo = open_photos(real_data / "real" / "scan2cad")[0]
    assert photo.camera is not None
    compared = 0
    for found in photo.objects:
        pose = found.truth.cam_from_model
        assert found.model is not None
        assert pose is not None
        view = ExportView(photo.camera, pose, photo.image)  # type: ignore[arg-type]
        exported = AlignedObject((view,), mesh=found.model.load_mesh(), name="chair")
        if not cast_geometry(Scene(exported.mesh), photo.camera, pose).mask.any():
            continue
        path = export_object(tmp_path / f"{found.object_id}.glb", exported)
        assert agrees(three, path, exported) >= LEAST_IOU
        compared += 1
    assert compared == 2


def test_camera_holds_the_whole_photo_about_the_principal_point(tmp_path: Path) -> None:
    path = export_object(tmp_path / "wedge.glb", aligned(tmp_path))
    (camera,) = tree_of(path)["cameras"]
    # Farthest borders: 320 - 0.5 - 140.3 = 179.2 px to the right, 131.2 + 0.5 = 131.7 px upwards.
    across, down = 179.2 / 400, 131.7 / 390
    assert camera["perspective"]["yfov"] == pytest.approx(2 * np.arctan(down))
    assert camera["perspective"]["aspectRatio"] == pytest.approx(across / down)


def test_trimesh_reads_mesh_texture_and_place(tmp_path: Path) -> None:
    exported = aligned(tmp_path)
    path = export_object(tmp_path / "wedge.glb", exported)
    scene = trimesh.load(path)
    assert set(scene.geometry) == {"model_0", "model_1", "photo_0"}
    scene.delete_geometry("photo_0")
    expected = exported.placed_mesh.bounds * [1, -1, -1]
    np.testing.assert_allclose(scene.bounds, np.sort(expected, axis=0), atol=1e-6)
    texture = exported.mesh.materials[0].texture
    image = scene.geometry["model_0"].visual.material.baseColorTexture
    np.testing.assert_array_equal(np.asarray(image.convert("RGB")), texture)


def test_opposite_borders_of_the_photo_do_not_mix(tmp_path: Path) -> None:
    tree = tree_of(export_object(tmp_path / "wedge.glb", aligned(tmp_path)))
    unlit = "KHR_materials_unlit"
    (photo,) = (each for each in tree["materials"] if unlit in each.get("extensions", {}))
    texture = tree["textures"][photo["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
    assert set(tree["samplers"][texture["sampler"]].values()) == {33071}  # clamp to edge


def test_colors_are_linear_light(tmp_path: Path) -> None:
    tree = tree_of(export_object(tmp_path / "wedge.glb", aligned(tmp_path)))
    (red,) = (each for each in tree["materials"] if each["name"] == "red")
    srgb = np.array([0.8, 0.1, 0.2])
    linear = [*((srgb + 0.055) / 1.055) ** 2.4, 1.0]
    assert red["pbrMetallicRoughness"]["baseColorFactor"] == pytest.approx(linear, rel=1e-6)


def test_vertex_colors_replace_the_material_color(tmp_path: Path) -> None:
    exported = aligned(tmp_path)
    mesh = exported.mesh
    colors = np.tile([0.5, 0.25, 1.0, 1.0], (len(mesh.vertices), 1))
    grey = Material("grey", (0.2, 0.2, 0.2, 1.0))
    colored = Mesh(mesh.vertices, mesh.faces, vertex_colors=colors, materials=(grey,))
    path = export_object(tmp_path / "colored.glb", replace(exported, mesh=colored))
    looks = [each for each in tree_of(path)["materials"] if each["name"] == "grey"]
    assert looks[0]["pbrMetallicRoughness"]["baseColorFactor"] == [1, 1, 1, 1]
    found = load_mesh(path)
    assert found.vertex_colors is not None
    assert np.abs(found.vertex_colors[:, :3] - [0.5, 0.25, 1.0]).max(axis=1).min() < 0.01


def test_every_view_has_a_posed_camera(tmp_path: Path) -> None:
    exported = aligned(tmp_path)
    other, cam_from_first = turned(exported.views[0], 0.4)
    path = export_object(tmp_path / "two.glb", replace(exported, views=(*exported.views, other)))
    tree = tree_of(path)
    nodes = {each["name"]: each for each in tree["nodes"]}
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    first, second = (
        np.reshape(nodes[f"camera_{number}"]["matrix"], (4, 4)).T for number in range(2)
    )
    np.testing.assert_allclose(first, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(second, flip @ np.linalg.inv(cam_from_first) @ flip, atol=1e-9)


@pytest.mark.slow
def test_undistorted_photo_keeps_its_corners() -> None:
    _, low, high = photo_plane(LENS, photo_of(LENS))
    corners = LENS.normalize([[-0.5, -0.5], [319.5, 239.5]])
    step = 1 / 300
    assert (low <= corners[0] + step).all()
    assert (high >= corners[1] - step).all()


@pytest.mark.long
def test_missing_inputs_are_named(tmp_path: Path) -> None:
    gone = replace(aligned(tmp_path).views[0], image=tmp_path / "gone.png")
    with pytest.raises(DataError, match=r"gone\.png: no such file"):
        export_object(tmp_path / "a.glb", replace(aligned(tmp_path), views=(gone,)))
    assert not (tmp_path / "a.glb").exists()


def test_a_model_may_have_the_name_of_a_photo(tmp_path: Path) -> None:
    path = export_object(tmp_path / "a.glb", aligned(tmp_path, name="photo"))
    scene = trimesh.load(path)
    assert isinstance(scene, trimesh.Scene)
    assert len(scene.geometry) == 3
