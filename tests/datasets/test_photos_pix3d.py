"""Pix3D: axes, focal length on its sensor, keypoints of several annotators."""

from __future__ import annotations

import numpy as np
import pytest
from support.files import TETRAHEDRON, write_json
from support.photo_data import assert_damage_is_told, rigid, write_photo, write_text

import cadalign.datasets
from cadalign.datasets import Pix3D
from cadalign.errors import DataError


def entry(**changes):
    pose = rigid(5, (0.1, -0.2, 1.5))
    found = {
        "img": "img/chair/0001.png", "category": "chair", "img_size": [320, 240],
        "2d_keypoints": [[[10, 20], [-1, -1], [30, 40]], [[12, 22], [-1, -1], [-1, -1]]],
        "mask": "mask/chair/0001.png", "model": "model/chair/a/model.obj",
        "3d_keypoints": "model/chair/a/3d_keypoints.txt", "rot_mat": pose[:3, :3].tolist(),
        "trans_mat": pose[:3, 3].tolist(), "focal_length": 35.0, "truncated": False,
        "occluded": "false", "slightly_occluded": True, "bbox": [5, 6, 50, 60],
    }  # fmt: skip
    return {**found, **changes}


@pytest.fixture
def root(tmp_path):
    write_json(tmp_path / "pix3d.json", [entry()])
    write_photo(tmp_path / "img/chair/0001.png", 320, 240)
    write_photo(tmp_path / "mask/chair/0001.png", 320, 240, grey=True)
    write_text(tmp_path / "model/chair/a/model.obj", TETRAHEDRON)
    write_text(tmp_path / "model/chair/a/3d_keypoints.txt", "0 0 0\n1 0 0\n0 1 0\n")
    return tmp_path


def test_the_camera_has_x_to_the_left_y_up_and_looks_along_z(root):
    """A camera in Blender that is turned by 180 degrees about y: seen are points of z > 0."""
    (photo,) = dataset = cadalign.datasets.open(root)
    assert isinstance(dataset, Pix3D)
    (chair,) = photo.objects
    assert photo.camera.fx == pytest.approx(35 / 32 * 320)
    x, y, z = np.array(entry()["rot_mat"]) @ [0.3, 0.1, 0.2] + entry()["trans_mat"]
    # From the image's left and upper border, then from the corner pixel's centre.
    u = 160 - 350 * x / z - 0.5
    v = 120 - 350 * y / z - 0.5
    pixel = photo.camera.project(chair.truth.cam_from_model.apply([[0.3, 0.1, 0.2]]))
    np.testing.assert_allclose(pixel, [[u, v]])


def test_keypoints_are_the_mean_of_those_who_marked_them(root):
    chair = cadalign.datasets.open(root)[0].objects[0]
    assert chair.keypoints.names == ("0", "2")
    np.testing.assert_allclose(chair.keypoints.points_2d, [[10.5, 20.5], [29.5, 39.5]])
    assert chair.model.load_keypoints().xyz.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert chair.model.load_mesh().faces.shape == (4, 3)
    assert chair.read_mask().all()


def test_missing_parts_are_none(root):
    thin = entry(img="none.png", model="gone.obj", mask="gone.png")
    del thin["2d_keypoints"], thin["3d_keypoints"], thin["rot_mat"]
    write_json(root / "pix3d.json", [thin])
    (photo,) = Pix3D(root)
    assert photo.image is None
    (chair,) = photo.objects
    assert (chair.keypoints, chair.model.load_keypoints(), chair.truth.rotation) == (None,) * 3
    with pytest.raises(DataError, match="no mesh"):
        chair.model.load_mesh()
    with pytest.raises(DataError, match="no mask"):
        chair.read_mask()


def test_bad_records_do_not_stop_the_others(root):
    bad = [
        entry(img_size=[0, 240]),
        entry(rot_mat=[[1, 0, 0], [0, 1, 0], [0, 0, 5]]),
        entry(focal_length=-1),
        entry(**{"2d_keypoints": [[[1, 2]], [[1, 2], [3, 4]]]}),
        {"category": "chair"},
        3,
        None,
    ]
    write_json(root / "pix3d.json", [*bad, entry()])
    dataset = Pix3D(root)
    assert [photo.name for photo in dataset] == ["7"]
    assert sorted(dataset.problems) == [str(number) for number in range(7)]
    for number, error in dataset.problems.items():
        assert "pix3d.json" in str(error) or str(root) in str(error)
        assert number in str(error)


def test_damaged_files_are_reported(root):
    write_text(root / "model/chair/a/3d_keypoints.txt", "0 0\n1 x 0\n")
    with pytest.raises(DataError, match=r"3d_keypoints\.txt"):
        Pix3D(root)[0].objects[0].model.load_keypoints()
    (root / "pix3d.json").write_text((root / "pix3d.json").read_text()[:-20])
    with pytest.raises(DataError, match=r"pix3d\.json.*cut short or damaged"):
        Pix3D(root)
    (root / "pix3d.json").rename(root / "pix.json")
    with pytest.raises(DataError, match="no data set of photos is recognised"):
        cadalign.datasets.open(root)
    with pytest.raises(DataError, match="no such file"):
        Pix3D(root)


def test_any_damage_is_reported(root):
    assert_damage_is_told(root)


def test_a_keypoint_at_the_border_is_marked(root):
    marked = [[[0, 20], [-1, -1], [30, 0.5]], [[0, 22], [-1, -1], [-1, -1]]]
    write_json(root / "pix3d.json", [entry(**{"2d_keypoints": marked})])
    (shown,) = Pix3D(root)[0].objects
    np.testing.assert_array_equal(shown.keypoints.points_2d, [[-0.5, 20.5], [29.5, 0.0]])
