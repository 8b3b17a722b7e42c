"""BOP's files of poses: truth written and read back, and files that are damaged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.exported import POSE, aligned, wedge

from cadalign import Alignment
from cadalign.datasets import Bop, load_mesh
from cadalign.datasets.photos.bop_files import (
    photo_numbers,
    read_bop_results,
    read_scene_gt,
    write_bop_results,
    write_scene_gt,
)
from cadalign.datasets.photos.dataset import PoseEstimate
from cadalign.errors import DataError, InputError
from cadalign.export import ExportOptions, export_object
from cadalign.geometry.rotations import rotation_from_vector

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
GOOD = "1,5,2,0.9,1 0 0 0 1 0 0 0 1,1 2 3,-1"


def poses(count: int = 20) -> list[PoseEstimate]:
    rng = np.random.default_rng(0)
    return [
        PoseEstimate(
            "3",
            str(number // 4),
            f"obj_{1 + number % 4:06d}",
            Alignment(rotation_from_vector(rng.normal(0, 2, 3)), rng.normal(0, 800, 3), np.ones(3)),
        )
        for number in range(count)
    ]


def assert_same(read: tuple[PoseEstimate, ...], written: list[PoseEstimate]) -> None:
    assert [(e.scene, e.image, e.model_id) for e in read] == [
        (e.scene, e.image, e.model_id) for e in written
    ]
    for one, other in zip(read, written, strict=True):
        np.testing.assert_allclose(
            one.cam_from_model.packed, other.cam_from_model.packed, rtol=0, atol=1e-6
        )


def test_poses_come_back_from_both_files(tmp_path: Path) -> None:
    written = poses()
    write_bop_results(tmp_path / "results.csv", written)
    assert_same(read_bop_results(tmp_path / "results.csv")[0], written)
    scene = tmp_path / "000003"
    scene.mkdir()
    write_scene_gt(scene / "scene_gt.json", written)
    assert_same(read_scene_gt(scene / "scene_gt.json")[0], written)


def test_truth_of_real_photos_comes_back(tmp_path: Path, real_data: Path) -> None:
    written = [
        PoseEstimate("2", photo.name, found.category, found.truth.cam_from_model)
        for photo in Bop(real_data / "real" / "lmo_multiview")
        for found in photo.objects
        if found.truth.cam_from_model is not None
    ]
    assert len(written) == 24
    write_bop_results(tmp_path / "results.csv", written)
    assert_same(read_bop_results(tmp_path / "results.csv")[0], written)


def test_a_stretch_becomes_the_mesh_beside_the_poses(tmp_path: Path) -> None:
    exported = aligned(tmp_path, metres=0.5)
    export_object(tmp_path / "scene", exported, format="bop")
    (photo,) = Bop(tmp_path / "scene")
    (found,) = photo.objects
    pose = found.truth.cam_from_model
    assert photo.name == "7"
    assert found.model is not None
    assert pose is not None
    np.testing.assert_allclose(pose.translation, 500 * POSE.translation, atol=1e-9)
    mesh = load_mesh(tmp_path / "scene" / "models" / "obj_000001.ply")
    expected = 500 * POSE.apply(wedge().vertices)
    np.testing.assert_allclose(pose.apply(mesh.vertices), expected, atol=1e-3)
    assert found.model.bounds is not None
    np.testing.assert_allclose(found.model.bounds, mesh.bounds, atol=1e-3)
    gaps = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices, axis=2)
    assert found.model.diameter == pytest.approx(gaps.max(), abs=1e-3)


def test_a_stretch_without_a_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="BOP's poses have no stretch"):
        export_object(tmp_path / "a.csv", aligned(tmp_path, mesh=None))
    stretched = replace(poses(1)[0], cam_from_model=POSE)
    with pytest.raises(InputError, match=r"poses\[0\]: the pose has the stretch"):
        write_bop_results(tmp_path / "a.csv", [stretched])


def test_models_of_other_objects_are_kept(tmp_path: Path) -> None:
    for number in (1, 2):
        options = ExportOptions(object_id=number)
        export_object(tmp_path / "a.csv", aligned(tmp_path), options=options)
    info = json.loads((tmp_path / "models" / "models_info.json").read_text())
    assert set(info) == {"1", "2"}


def test_photos_of_one_name_have_numbers_of_their_own() -> None:
    photos = [Path("a/x.png"), Path("a/7.png"), Path("b/0007.png"), Path("a/0.png"), 5]
    assert list(photo_numbers(photos).items()) == [
        *((photos[1], 7), (photos[3], 0), (photos[0], 1), (photos[2], 2), (5, 3))
    ]


def test_a_second_object_changes_nothing_of_the_first(tmp_path: Path) -> None:
    folder, first = tmp_path / "scene", aligned(tmp_path)
    for _ in range(2):  # the same once more is no other object
        export_object(folder, first, format="bop")
    before = {path: path.read_bytes() for path in folder.rglob("*.*")}
    (pose,) = read_scene_gt(folder / "scene_gt.json")[0]
    second = replace(first, metres=0.5)
    for format, to in (("bop", folder), ("bop-results", folder / "b.csv")):
        with pytest.raises(DataError, match="holds another mesh; give another object_id"):
            export_object(to, second, format=format)
    assert before == {path: path.read_bytes() for path in folder.rglob("*.*")}
    export_object(folder, second, format="bop", options=ExportOptions(object_id=2))
    both = read_scene_gt(folder / "scene_gt.json")[0]
    assert [each.model_id for each in both] == ["obj_000001", "obj_000002"]
    np.testing.assert_array_equal(both[0].cam_from_model.packed, pose.cam_from_model.packed)
    (view,) = first.views
    other = replace(first, views=(replace(view, camera=replace(view.camera, fx=300.0)),))
    with pytest.raises(DataError, match="photo 7 has another camera; give another image_id"):
        export_object(folder, other, format="bop")


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1,5,2,0.9,1 0 0 0 1 0 0 0 1,1 2 3", "6 cells, expected 7"),
        ("1,5,2,0.9,1 0 0 0 1 0 0 0,1 2 3,-1", "R '1 0 0 0 1 0 0 0' is not 9 finite numbers"),
        ("1,5,2,0.9,2 0 0 0 2 0 0 0 2,1 2 3,-1", "not a rotation matrix"),
        ("1,5,2,0.9,1 0 0 0 1 0 0 0 1,1 nan 3,-1", "t '1 nan 3' is not 3 finite numbers"),
        ("1,x,2,0.9,1 0 0 0 1 0 0 0 1,1 2 3,-1", "im_id 'x' is not a whole number"),
    ],
)
def test_a_bad_line_is_told_of_and_the_rest_is_read(tmp_path: Path, line: str, reason: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text("\n".join([HEADER, line, GOOD]) + "\n")
    (_,), (problem,) = read_bop_results(path)
    assert str(problem).startswith(f"{path}, line 2: {reason}")
    path.write_text("\n".join([HEADER, line]) + "\n")
    with pytest.raises(DataError, match="line 2"):
        read_bop_results(path)


def test_files_of_other_kinds_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_text("x,y\n1,2\n")
    with pytest.raises(DataError, match="the first line is not scene_id,im_id"):
        read_bop_results(path)
    with pytest.raises(DataError, match="no such file"):
        read_bop_results(tmp_path / "gone.csv")
    truth = tmp_path / "scene_gt.json"
    truth.write_text("[1]")
    with pytest.raises(DataError, match="not a table of lists of poses"):
        read_scene_gt(truth)
    truth.write_text('{"1": [{"cam_R_m2c": [1, 0')
    with pytest.raises(DataError, match="not valid JSON"):
        read_scene_gt(truth)


def test_a_bad_pose_of_scene_gt_is_told_of(tmp_path: Path) -> None:
    path = tmp_path / "scene_gt.json"
    good = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 900], "obj_id": 4}
    path.write_text(json.dumps({"5": [{**good, "cam_t_m2c": [0, 0]}, good], "x": [good]}))
    poses, problems = read_scene_gt(path)
    assert [each.image for each in poses] == ["5"]
    assert [str(each).split(": ")[1] for each in problems] == ["5[0].cam_t_m2c", "x"]
