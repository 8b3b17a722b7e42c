"""Meshes, cameras, keypoints and lines for other tools, read back by them or by their rules."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO
from support.exported import CAMERA, KEYPOINTS, LENS, POSE, aligned, turned, wedge

from cadalign import Mesh
from cadalign.datasets import load_mesh
from cadalign.errors import InputError
from cadalign.export import FORMATS, ExportOptions, export_object, format_of
from cadalign.export.camera_files import read_camera_views
from cadalign.export.usd import INSTALL
from cadalign.geometry.rotations import rotation_from_quat_wxyz

WORLD = np.array([[0.0, 0, 1, 5], [1, 0, 0, 6], [0, 1, 0, 7], [0, 0, 0, 1]])


@pytest.mark.parametrize("frame", ["camera", "world", "model"])
@pytest.mark.parametrize("ending", [".obj", ".ply"])
def test_mesh_files_hold_the_placed_mesh(tmp_path: Path, ending: str, frame: str) -> None:
    exported = aligned(tmp_path, world_from_cam=WORLD, metres=2.0)
    options = ExportOptions(frame=frame)  # type: ignore[arg-type]
    path = export_object(tmp_path / "new" / f"wedge{ending}", exported, options=options)
    expected = {
        "camera": POSE.apply(wedge().vertices),
        "world": POSE.apply(wedge().vertices) @ WORLD[:3, :3].T + WORLD[:3, 3],
        "model": wedge().vertices * POSE.scale,
    }[frame]
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.vertices, 2 * expected, atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, wedge().faces)


def test_obj_keeps_materials_and_texture(tmp_path: Path) -> None:
    mesh = load_mesh(export_object(tmp_path / "wedge.obj", aligned(tmp_path)))
    expected = wedge()
    np.testing.assert_array_equal(mesh.face_material, expected.face_material)
    np.testing.assert_array_equal(mesh.materials[0].texture, expected.materials[0].texture)
    assert mesh.materials[1].color == pytest.approx(expected.materials[1].color)
    assert mesh.corner_uv is not None
    np.testing.assert_allclose(mesh.corner_uv, expected.corner_uv, atol=1e-6)


def test_ply_keeps_colors(tmp_path: Path) -> None:
    colors = np.round(np.random.default_rng(0).uniform(0, 1, (6, 4)) * 255) / 255
    painted = replace(wedge(), vertex_colors=colors)
    mesh = load_mesh(export_object(tmp_path / "wedge.ply", aligned(tmp_path, mesh=painted)))
    assert mesh.vertex_colors is not None
    np.testing.assert_allclose(mesh.vertex_colors, colors, atol=1e-6)


@pytest.mark.parametrize("name", ["transforms.json", "camera.json", "colmap"])
def test_cameras_are_read_back_where_they_stood(tmp_path: Path, name: str) -> None:
    exported = aligned(tmp_path)
    other, _ = turned(exported.views[0], 0.3)
    two = replace(exported, views=(*exported.views, other))
    options = ExportOptions(frame="model")
    format = "colmap" if name == "colmap" else None
    path = export_object(tmp_path / "out" / name, two, format=format, options=options)
    found = read_camera_views(path)
    for view, read in zip(two.views, found, strict=True):
        np.testing.assert_allclose(
            read.cam_from_world.cam_from_model[:3, :3], view.cam_from_model.rotation, atol=1e-9
        )
        np.testing.assert_allclose(
            read.cam_from_world.translation, view.cam_from_model.translation, atol=1e-9
        )
        np.testing.assert_allclose(read.camera.matrix, CAMERA.matrix, atol=1e-9)
    if name == "transforms.json":
        assert found[0].name == "../000007.png"


def test_scan2cad_has_the_stretch_as_scale(tmp_path: Path) -> None:
    exported = aligned(tmp_path, world_from_cam=WORLD, metres=0.5)
    options = ExportOptions(frame="world", scan_id="scene0470_00", category_id="03001627")
    path = export_object(tmp_path / "annotations.json", exported, options=options)
    (scan,) = json.loads(path.read_text())
    (model,) = scan["aligned_models"]
    assert (scan["id_scan"], model["catid_cad"]) == ("scene0470_00", "03001627")
    trs = model["trs"]
    rotation = rotation_from_quat_wxyz(np.array(trs["rotation"]))
    placed = wedge().vertices * trs["scale"] @ rotation.T + trs["translation"]
    world = exported.frame_from_model("world")
    np.testing.assert_allclose(placed, 0.5 * world.apply(wedge().vertices), atol=1e-9)


def test_coco_has_observed_and_inferred_keypoints(tmp_path: Path) -> None:
    path = export_object(tmp_path / "a.coco.json", aligned(tmp_path))
    coco = COCO(str(path))
    (annotation,) = coco.loadAnns(coco.getAnnIds(imgIds=[0]))
    (category,) = coco.loadCats([1])
    rows = np.reshape(annotation["keypoints"], (-1, 3))
    assert category["keypoints"] == ["0", "1", "2", "3"]
    assert rows[:, 2].tolist() == [2, 2, 2, 1]
    np.testing.assert_allclose(rows[:, :2], CAMERA.project(POSE.apply(KEYPOINTS)), atol=1e-3)
    assert coco.loadImgs([0])[0]["file_name"] == "000007.png"
    left, top, width, height = annotation["bbox"]
    pixels = CAMERA.project(POSE.apply(wedge().vertices)) + 0.5
    np.testing.assert_allclose([left, top], pixels.min(axis=0), atol=1e-9)
    np.testing.assert_allclose([left + width, top + height], pixels.max(axis=0), atol=1e-9)


def test_open3d_reads_the_lines(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed")
    exported = aligned(tmp_path)
    path = export_object(tmp_path / "wedge.lines.ply", exported)
    lines = open3d.io.read_line_set(str(path))
    assert len(lines.lines) == 12 + 8
    points = np.asarray(lines.points)
    low, high = wedge().bounds
    np.testing.assert_allclose(POSE.inverse(points[:8]).min(axis=0), low, atol=1e-9)
    np.testing.assert_allclose(POSE.inverse(points[:8]).max(axis=0), high, atol=1e-9)
    np.testing.assert_allclose(points[8], 0, atol=1e-12)  # the camera


@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usdz"])
def test_usd_places_model_camera_and_photo(tmp_path: Path, ending: str) -> None:
    pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom, UsdShade

    assert pxr is not None
    exported = aligned(tmp_path)
    path = export_object(tmp_path / f"wedge{ending}", exported)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    found = box.ComputeWorldBound(stage.GetPrimAtPath("/scene/model")).ComputeAlignedRange()
    # Of the model's parts the boxes are turned, so they hold the placed ones.
    expected = np.sort(exported.placed_mesh("camera").bounds * [1, -1, -1], axis=0)
    assert (np.array(found.GetMin()) <= expected[0] + 1e-5).all()
    assert (np.array(found.GetMax()) >= expected[1] - 1e-5).all()
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/view_0/camera")).GetCamera()
    frustum = camera.frustum
    photo = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/view_0/photo"))
    corners = np.array(photo.GetPointsAttr().Get())
    # The rectangle's farthest border is that of the field of view.
    window = frustum.GetWindow()
    assert np.abs(corners[:, 0] / corners[:, 2]).max() == pytest.approx(window.GetMax()[0], 1e-5)
    assert np.abs(corners[:, 1] / corners[:, 2]).max() == pytest.approx(window.GetMax()[1], 1e-5)
    assert np.abs(frustum.GetPosition()).max() < 1e-12
    part = stage.GetPrimAtPath("/scene/model/part_0")
    material = UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial()[0]
    assert material.GetPath() == "/scene/model/part_0/material"
    points = np.array(UsdGeom.Mesh(part).GetPointsAttr().Get())
    matrix = np.array(UsdGeom.Xformable(part).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    placed = np.column_stack([points, np.ones(len(points))]) @ matrix
    allowed = exported.placed_mesh("camera").vertices * [1, -1, -1]
    gaps = np.linalg.norm(placed[:, None, :3] - allowed, axis=2).min(axis=1)
    assert gaps.max() < 1e-5


def test_usd_has_the_vertex_colors_and_the_tint_of_textures(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom, UsdShade

    exported = aligned(tmp_path)
    mesh = exported.require_mesh()
    cloth, red = mesh.materials
    tinted = replace(mesh, materials=(replace(cloth, color=(0.5, 1.0, 1.0, 1.0)), red))
    path = export_object(tmp_path / "tinted.usda", replace(exported, mesh=tinted))
    stage = Usd.Stage.Open(str(path))
    texture = UsdShade.Shader(stage.GetPrimAtPath("/scene/model/part_0/material/texture"))
    scale = np.array(texture.GetInput("scale").Get())
    np.testing.assert_allclose(scale, [0.214, 1, 1, 1], atol=5e-3)  # 0.5 in linear light

    colors = np.random.default_rng(0).uniform(0, 1, (len(mesh.vertices), 4))
    colored = Mesh(mesh.vertices, mesh.faces, vertex_colors=colors, materials=(red,))
    path = export_object(tmp_path / "colored.usda", replace(exported, mesh=colored))
    stage = Usd.Stage.Open(str(path))
    part = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/model/part_0"))
    points = np.array(part.GetPointsAttr().Get())
    shown = np.array(UsdGeom.PrimvarsAPI(part).GetPrimvar("displayColor").Get())
    rows = np.linalg.norm(points[:, None] - mesh.vertices, axis=2).argmin(axis=1)
    np.testing.assert_allclose(shown**0.4545, colors[rows, :3], atol=0.04)
    surface = UsdShade.Shader(stage.GetPrimAtPath("/scene/model/part_0/material/surface"))
    source = surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source
    assert source.GetPath() == "/scene/model/part_0/material/colors"


def test_without_usd_the_install_command_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError) as caught:
        export_object(tmp_path / "a.usdz", aligned(tmp_path))
    assert caught.value.fix == INSTALL
    assert "pip install" in INSTALL


def test_lens_distortion_is_refused_where_it_has_no_place(tmp_path: Path) -> None:
    for name in ("camera.json", "scene_gt.json"):
        with pytest.raises(InputError, match="no place for lens distortion"):
            export_object(tmp_path / "out" / name, aligned(tmp_path, camera=LENS))


def test_names_tell_formats() -> None:
    for key, each in FORMATS.items():
        for ending in each.endings:
            assert format_of(f"folder/x{ending}" if ending.startswith(".") else ending) == key
    with pytest.raises(InputError, match=r"a\.json: the name does not tell the format; give the"):
        format_of("a.json")


def test_unknown_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="format: unknown format 'x3d'; known are glb"):
        export_object(tmp_path / "a.x3d", aligned(tmp_path), format="x3d")
    with pytest.raises(InputError, match="frame: unknown frame 'moon'"):
        ExportOptions(frame="moon")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="scene_id: -1 is not a whole number"):
        ExportOptions(scene_id=-1)
    with pytest.raises(InputError, match="world_from_cam: not a rigid motion"):
        aligned(tmp_path, world_from_cam=2 * np.eye(4))


@pytest.mark.parametrize("name", ["far.ply", "far.obj"])
def test_mesh_files_far_from_their_origin_keep_their_form(tmp_path: Path, name: str) -> None:
    world = np.eye(4)
    world[:3, 3] = 400_000.123, 5_800_000.456, 30.0
    exported = aligned(tmp_path, world_from_cam=world)
    options = ExportOptions(frame="world")
    mesh = load_mesh(export_object(tmp_path / name, exported, options=options))
    expected = POSE.apply(wedge().vertices) + world[:3, 3]
    np.testing.assert_allclose(mesh.vertices, expected, rtol=0, atol=1e-7)


def test_photos_of_one_name_are_told_apart(tmp_path: Path) -> None:
    first = aligned(tmp_path).views[0]
    views = []
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        photo = tmp_path / side / "000007.png"
        photo.write_bytes((tmp_path / "000007.png").read_bytes())
        views.append(replace(first, image=photo))
    two = replace(aligned(tmp_path), views=tuple(views))
    names = ["left/000007.png", "right/000007.png"]
    export_object(tmp_path / "a.coco.json", two)
    coco = json.loads((tmp_path / "a.coco.json").read_text())
    assert [image["file_name"] for image in coco["images"]] == names
    export_object(tmp_path / "cameras", two, format="colmap")
    assert [view.name for view in read_camera_views(tmp_path / "cameras")] == names


def test_usd_cuts_out_the_transparent_pixels_of_textures(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdShade

    plain = wedge()
    cloth, red = plain.materials
    assert cloth.texture is not None
    opacity = np.where(np.arange(8) < 4, 0, 255).astype(np.uint8)
    leaf = np.dstack([cloth.texture, np.tile(opacity, (8, 1))])
    mesh = replace(plain, materials=(replace(cloth, texture=leaf), red))
    stage = Usd.Stage.Open(str(export_object(tmp_path / "a.usda", aligned(tmp_path, mesh=mesh))))
    shader = UsdShade.Shader.Get(stage, "/scene/model/part_0/material/surface")
    assert shader.GetInput("opacity").HasConnectedSource()
    assert shader.GetInput("opacityThreshold").Get() == 0.5
    other = UsdShade.Shader.Get(stage, "/scene/model/part_1/material/surface")
    assert not other.GetInput("opacity").HasConnectedSource()
