"""BOP: whole data sets, splits, scenes and scene_gt.json alone; symmetries, masks and depth."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from support.files import write_json
from support.photo_data import (
    TETRAHEDRON_PLY,
    assert_damage_is_told,
    bop_pose,
    rigid,
    write_bop,
    write_photo,
    write_text,
)

import cadalign.datasets
from cadalign.datasets import Bop, PosedPhotos
from cadalign.errors import DataError


def edit(path, change):
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


@pytest.mark.parametrize("below", [".", "test", "test/000001"])
def test_a_data_set_a_split_and_a_scene(tmp_path, below):
    pose = write_bop(tmp_path)
    dataset = cadalign.datasets.open(tmp_path / below)
    assert isinstance(dataset, Bop)
    assert len(dataset) == 2
    for photo in dataset:
        (shown,) = photo.objects
        found = shown.truth.cam_from_model
        np.testing.assert_allclose(found.cam_from_model, pose, atol=1e-9)
        assert shown.truth.metres == 1e-3
        assert (photo.camera.fx, photo.camera.fy, photo.camera.cy) == (500, 510, 23.5)
        np.testing.assert_array_equal(shown.bbox, [10, 12, 30, 28])
        assert shown.visible_fraction == 0.75
        assert shown.read_mask().all()
        np.testing.assert_allclose(photo.depth.read(), np.full((48, 64), 400.0))
        assert shown.model.diameter == 14.142
        mesh = shown.model.load_mesh()
        np.testing.assert_allclose(mesh.bounds, shown.model.bounds)
        np.testing.assert_allclose(shown.truth.box.extents, [10, 10, 10])
    assert dataset.problems == {}


def test_symmetries_are_those_of_models_info(tmp_path):
    write_bop(tmp_path)
    symmetry = Bop(tmp_path)[0].objects[0].symmetry
    assert (len(symmetry.motions), len(symmetry.axes)) == (1, 1)
    np.testing.assert_allclose(symmetry.axes[0].direction, [0, 0, 1])
    # ceil(pi / 0.5) = 7 steps about the axis, each with and without the discrete motion.
    assert len(symmetry.poses(max_step=0.5)) == 14
    for motion in symmetry.poses(max_step=0.5):
        np.testing.assert_allclose(motion @ [5, 5, 3, 1], [5, 5, 3, 1], atol=1e-9)


def test_the_truth_alone_with_a_common_camera(tmp_path):
    write_json(tmp_path / "scene_gt.json", {"3": [bop_pose(rigid(1, (0, 0, 500)))]})
    camera = {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480}
    write_json(tmp_path / "camera.json", camera)
    (photo,) = Bop(tmp_path)
    assert photo.image is None
    assert photo.camera.width == 640
    assert photo.objects[0].model is None
    del camera["width"]
    write_json(tmp_path / "camera.json", camera)
    assert next(iter(Bop(tmp_path))).camera is None
    (tmp_path / "camera.json").unlink()
    with pytest.raises(DataError, match="no camera of photo 3"):
        Bop(tmp_path)[0]


def test_bad_poses_photos_and_scenes_do_not_stop_the_others(tmp_path):
    pose = write_bop(tmp_path, photos=4)
    scene = tmp_path / "test" / "000001"
    bad = bop_pose(pose)
    bad["cam_R_m2c"] = [1, 0, 0, 0, 1, 0, 0, 0, -1]

    def spoil(table):
        table["1"] = [bad, {"obj_id": 1}, *table["1"]]
        return {**table, "2": "x", "three": table["3"]}

    edit(scene / "scene_gt.json", spoil)
    write_text(tmp_path / "test" / "000002" / "scene_gt.json", '{"1": [')
    dataset = Bop(tmp_path)
    photos = {photo.name: photo for photo in dataset}
    assert sorted(photos) == ["test/000001/0", "test/000001/1", "test/000001/3"]
    assert [each.object_id for each in photos["test/000001/1"].objects] == ["2"]
    assert len(dataset.problems) == 5
    assert "not valid JSON" in str(dataset.problems[str(tmp_path / "test" / "000002")])
    assert "cut short" in str(dataset.problems[str(tmp_path / "test" / "000002")])


def test_damaged_models_info_is_told(tmp_path):
    write_bop(tmp_path)
    path = tmp_path / "models" / "models_info.json"
    edit(path, lambda table: {"1": {**table["1"], "symmetries_continuous": [{"axis": [0, 0, 0]}]}})
    photo = Bop(tmp_path)[0]
    assert photo.objects == ()
    assert "models_info.json: 1.direction" in str(photo.problems[0])
    edit(path, lambda table: {})
    assert Bop(tmp_path)[0].objects[0].symmetry.is_trivial


def test_a_file_of_posed_photos(tmp_path):
    pose = rigid(2, (1, 2, 300))
    camera = {"fx": 500, "fy": 500, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
    entry = {"model": "m/obj_000007.ply", "cam_from_model": pose.tolist(), "camera": camera}
    write_json(tmp_path / "poses.json", {"a/1.jpg": entry, "b.jpg": {**entry, "camera": None}})
    write_photo(tmp_path / "a" / "1.jpg")
    write_text(tmp_path / "m" / "obj_000007.ply", TETRAHEDRON_PLY)
    dataset = cadalign.datasets.open(tmp_path)
    assert isinstance(dataset, PosedPhotos)
    (photo,) = dataset
    np.testing.assert_allclose(photo.objects[0].truth.cam_from_model.cam_from_model, pose)
    assert photo.objects[0].model.load_mesh() is not None
    assert "b.jpg.camera" in str(dataset.problems["b.jpg"])


@pytest.mark.slow
def test_damaged_files_are_told(tmp_path):
    write_bop(tmp_path, photos=1)
    assert_damage_is_told(tmp_path)


@pytest.mark.long
def test_thousands_of_photos_take_little_time(tmp_path):
    """Were it the square of their number that time grows with, ten thousand would take 60 s."""
    write_bop(tmp_path, photos=4000, images=False)
    camera = {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480}
    write_json(tmp_path / "camera.json", camera)
    begin = time.process_time()
    summary = Bop(tmp_path).summary()
    assert time.process_time() - begin < 60 * 0.4**2
    assert (summary.photos, summary.objects, summary.images) == (4000, 4000, 0)


@pytest.mark.long
def test_the_table_of_six_photos_stands_still(real_data):
    """All pairs of objects move alike from photo to photo: the truth is one table."""
    dataset = cadalign.datasets.open(real_data / "real" / "lmo_multiview")
    assert len(dataset) == 6
    between = []
    for photo in dataset:
        first, second = (each.truth.cam_from_model.cam_from_model for each in photo.objects[:2])
        between.append(np.linalg.inv(first) @ second)
        assert photo.image is not None
        box = photo.objects[0].model.load_mesh().bounds
        assert 50 < np.ptp(box, axis=0).max() < 300  # millimetres
    np.testing.assert_allclose(between, [between[0]] * 6, atol=1e-3)


@pytest.mark.slow
def test_the_samples_of_posed_photos(real_data):
    dataset = cadalign.datasets.open(real_data / "real" / "bop_samples")
    photos = list(dataset)
    assert len(photos) == 10
    for photo in photos:
        (shown,) = photo.objects
        vertices = shown.model.load_mesh().vertices
        pixels = photo.camera.project(shown.truth.cam_from_model.apply(vertices))
        assert photo.camera.contains(pixels).mean() > 0.9
        assert photo.read_image().shape[:2] == (photo.camera.height, photo.camera.width)
