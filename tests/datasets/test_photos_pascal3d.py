"""PASCAL3D+: viewpoints, anchors, CAD models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.io import savemat
from support.photo_data import assert_damage_is_told, write_photo

import cadalign.datasets
from cadalign.datasets import Pascal3D
from cadalign.datasets.pascal3d import cad_model
from cadalign.errors import DataError

POINTS = np.array([[0.2, 0.1, 0.3], [-0.2, 0.1, 0.3], [0.2, -0.4, -0.3], [-0.2, -0.4, -0.3]])
VIEW = {
    "azimuth": 40.0, "elevation": 15.0, "distance": 6.0, "focal": 1.0, "px": 101.0, "py": 81.0,
    "theta": 5.0, "viewport": 3000.0,
}  # fmt: skip


def project_3d(points, view):
    """PASCAL3D+'s own projection, in MATLAB's pixels, written from its project_3d.m."""
    a, e, theta = (np.radians(view[name]) for name in ("azimuth", "elevation", "theta"))
    d = view["distance"]
    center = [d * np.cos(e) * np.sin(a), -d * np.cos(e) * np.cos(a), d * np.sin(e)]
    a, e = -a, -(np.pi / 2 - e)
    rz = [[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
    rx = [[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]]
    rotation = np.array(rx) @ rz
    focal = view["viewport"] * view["focal"]
    x = np.diag([focal, focal, -1]) @ (rotation @ (points - center).T)
    turn = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
    flat = (turn @ (x[:2] / x[2])).T * [1, -1]
    return flat + [view["px"], view["py"]]


def annotated(**changes):
    pixels = project_3d(POINTS, VIEW)
    anchors = {
        "left": {"location": pixels[0], "status": 1.0},
        "right": {"location": pixels[1], "status": 1.0},
        "hidden": {"location": np.empty((0, 0)), "status": 2.0},
    }
    found = {
        "class": "chair", "bbox": np.array([11.0, 21.0, 51.0, 61.0]), "anchors": anchors,
        "viewpoint": VIEW, "cad_index": 2.0, "truncated": 1.0, "occluded": 0.0, "difficult": 0.0,
    }  # fmt: skip
    return {**found, **changes}


def write_record(path, *objects):
    path.parent.mkdir(parents=True, exist_ok=True)
    objects = np.array(list(objects), dtype=object)
    record = {"filename": f"{path.stem}.jpg", "objects": objects}
    savemat(path, {"record": record})
    return path


def write_cad(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    first = {
        "vertices": POINTS, "faces": np.array([[1.0, 2, 3], [1, 3, 4]]),
        "pnames": np.array(["left", "right", "hidden"], dtype=object), "left": POINTS[0],
        "right": POINTS[1], "hidden": np.empty((0, 0)),
    }  # fmt: skip
    second = {**first, "left": POINTS[0] * [1, 1, 2]}
    savemat(path, {path.stem: np.array([first, second], dtype=object)})


@pytest.fixture
def root(tmp_path):
    write_cad(tmp_path / "CAD" / "chair.mat")
    folder = tmp_path / "Annotations" / "chair_pascal"
    write_record(folder / "2008_000001.mat", annotated(), annotated(**{"class": "sofa"}))
    write_photo(tmp_path / "Images" / "chair_pascal" / "2008_000001.jpg", 200, 160)
    return tmp_path


def test_the_truth_projects_as_the_reference_does(root):
    (photo,) = dataset = cadalign.datasets.open(root)
    assert isinstance(dataset, Pascal3D)
    assert photo.name == "chair_pascal/2008_000001"
    assert not photo.camera.focal_known
    (chair,) = photo.objects  # the sofa is not this folder's
    camera, pose = chair.truth.camera, chair.truth.cam_from_model
    np.testing.assert_allclose(
        camera.project(pose.apply(POINTS)) + 1, project_3d(POINTS, VIEW), atol=1e-9
    )
    assert np.linalg.norm(pose.translation) == pytest.approx(6.0)
    np.testing.assert_array_equal(chair.bbox, [10, 20, 50, 60])


def test_visible_anchors_belong_to_the_models(root):
    chair = cadalign.datasets.open(root)[0].objects[0]
    assert chair.keypoints.names == ("left", "right")
    points = chair.model.load_keypoints()
    assert points.names == ("left", "right")
    np.testing.assert_allclose(points.xyz, [POINTS[0] * [1, 1, 2], POINTS[1]])
    np.testing.assert_allclose(chair.keypoints.points_2d + 1, project_3d(POINTS[:2], VIEW))
    assert chair.model.load_mesh().faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert chair.model.model_id == "chair/02"


def test_the_photo_must_be_there_as_its_size_is_the_cameras(root):
    (root / "Images" / "chair_pascal" / "2008_000001.jpg").unlink()
    with pytest.raises(DataError, match=r"2008_000001.mat: its image is not in Images"):
        Pascal3D(root)[0]


def test_objects_without_a_continuous_viewpoint_have_no_pose(root):
    path = root / "Annotations" / "chair_pascal" / "2008_000001.mat"
    nothing = np.empty((0, 0))
    write_record(
        path,
        annotated(viewpoint={**VIEW, "distance": 0.0}),
        annotated(viewpoint=nothing, anchors=nothing, cad_index=nothing),
    )
    photo = Pascal3D(root)[0]
    assert [each.truth.rotation for each in photo.objects] == [None, None]
    assert photo.objects[1].keypoints is None
    assert photo.objects[1].model is None


def test_bad_objects_and_files_do_not_stop_the_others(root):
    folder = root / "Annotations" / "chair_pascal"
    good = (folder / "2008_000001.mat").read_bytes()
    (folder / "a.mat").write_bytes(good[: len(good) // 2])
    (folder / "b.mat").write_bytes(b"")
    (folder / "c.mat").write_text("not MATLAB's")
    savemat(folder / "d.mat", {"other": 1.0})
    write_record(
        folder / "e.mat",
        annotated(bbox=np.array([1.0, 2.0])),
        annotated(viewpoint={**VIEW, "azimuth": "x"}),
        annotated(cad_index=np.inf),
        annotated(),
    )
    write_photo(root / "Images" / "chair_pascal" / "e.jpg", 200, 160)
    dataset = Pascal3D(root)
    photos = {photo.name.split("/")[1]: photo for photo in dataset}
    assert sorted(photos) == ["2008_000001", "e"]
    assert [each.object_id for each in photos["e"].objects] == ["3"]
    assert len(dataset.problems) == 4 + 3
    for name in "abcd":
        assert f"{name}.mat" in str(dataset.problems[f"chair_pascal/{name}"])


def test_cad_files_are_checked_when_they_are_read(root):
    savemat(root / "CAD" / "chair.mat", {"chair": np.array([{"vertices": POINTS}], dtype=object)})
    with pytest.raises(DataError, match="no model 2, only 1"):
        cad_model(root, "chair", 2).load_mesh()
    with pytest.raises(DataError, match="faces"):
        cad_model(root, "chair", 1).load_mesh()


@pytest.mark.parametrize("number", [np.nan, np.inf, 1e30])
def test_faces_are_numbers_of_vertices(root, number):
    cad = {"vertices": POINTS, "faces": np.array([[1.0, 2, number]])}
    savemat(root / "CAD" / "chair.mat", {"chair": np.array([cad], dtype=object)})
    with pytest.raises(DataError, match="faces"):
        cad_model(root, "chair", 1).load_mesh()


def test_huge_angles_are_valid(root):
    path = root / "Annotations" / "chair_pascal" / "2008_000001.mat"
    write_record(path, annotated(viewpoint={**VIEW, "azimuth": 1e300}))
    (chair,) = Pascal3D(root)[0].objects
    assert np.isfinite(chair.truth.rotation).all()


def test_damaged_files_are_reported(root):
    assert_damage_is_told(root)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(DataError, match="there are no Annotations"):
        Pascal3D(tmp_path)


def test_a_real_file_of_models_is_read(real_data):
    model = cad_model(real_data / "real" / "pascal3d", "bottle", 1)
    assert len(model.load_mesh().faces) > 1000
    found = model.load_keypoints()
    assert len(found) > 3
    assert np.isfinite(found.xyz).all()
