"""Scan2CAD: truth in the camera's frame, keypoints, symmetries, and records that are bad."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
from support.files import replaced
from support.photo_data import (
    assert_damage_is_told,
    rigid,
    scan2cad_model,
    write_photo,
    write_scan2cad,
    write_text,
)

import cadalign.datasets
from cadalign.datasets import Scan2CAD
from cadalign.errors import DataError


@pytest.fixture
def root(tmp_path):
    write_scan2cad(tmp_path)
    return tmp_path


def edit(root, change):
    path = root / "full_annotations.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def test_the_truth_is_pose_and_stretch_in_the_camera(tmp_path):
    pose = write_scan2cad(tmp_path)
    dataset = Scan2CAD(tmp_path)
    assert dataset.names == ("scene0000_00/0", "scene0000_00/1")
    for photo in dataset:
        (chair,) = photo.objects
        truth = chair.truth
        np.testing.assert_allclose(truth.cam_from_model.rotation, pose[:3, :3], atol=1e-6)
        np.testing.assert_allclose(truth.cam_from_model.translation, pose[:3, 3], atol=1e-6)
        np.testing.assert_allclose(truth.cam_from_model.scale, [1, 2, 0.5])
        np.testing.assert_allclose(truth.box.extents, [0.6, 1.2, 0.3])
        assert (photo.camera.fx, photo.camera.cx, photo.camera.width) == (50, 31.5, 64)
        assert chair.category == "chair"
        assert chair.model.load_mesh().vertices.shape == (4, 3)
        assert photo.read_image().shape == (48, 64, 3)
    assert dataset.problems == {}


def test_keypoints_are_on_the_model_and_in_the_photo(root):
    photo = Scan2CAD(root)["scene0000_00/0"]
    (chair,) = photo.objects
    points = chair.model.load_keypoints()
    np.testing.assert_allclose(points.xyz[0], [0.3, 0.3, 0.3], atol=1e-9)
    rows = [points.names.index(name) for name in chair.keypoints.names]
    projected = photo.camera.project(chair.truth.cam_from_model.apply(points.xyz[rows]))
    # The scan's keypoints lie 1 cm along each axis of the world off the model's, 3 m away at 50 px.
    gaps = np.linalg.norm(projected - chair.keypoints.points_2d, axis=1)
    assert 0 < gaps.max() < 0.4


@pytest.mark.parametrize(
    ("name", "rotations", "axes"),
    [("NONE", 1, 0), ("ROTATE_UP_2", 2, 0), ("ROTATE_UP_4", 4, 0), ("ROTATE_UP_INF", 1, 1)],
)
def test_symmetries_turn_about_y_through_the_centre(tmp_path, name, rotations, axes):
    center = [0.1, 0.0, 0.2]
    write_scan2cad(tmp_path, sym=f"__SYM_{name}", center=center)
    symmetry = Scan2CAD(tmp_path)[0].objects[0].symmetry
    assert (len(symmetry.rotations), len(symmetry.axes)) == (rotations, axes)
    assert symmetry.center.tolist() == center
    for up in (*symmetry.rotations[:, :, 1], *symmetry.axes):
        np.testing.assert_allclose(up, [0, 1, 0], atol=1e-12)


def test_millimetres_for_metres_are_named(root):
    """The annotation is in millimetres, the frame's pose in metres."""

    def in_millimetres(scans):
        for part in (scans[0], *scans[0]["aligned_models"]):
            part["trs"]["translation"] = [1000 * v for v in part["trs"]["translation"]]
        return scans

    edit(root, in_millimetres)
    photo = Scan2CAD(root)[0]
    assert photo.objects == ()
    (problem,) = photo.problems
    assert "m from the camera, likely millimetres for metres" in str(problem)
    assert str(problem).startswith(f"{root / 'full_annotations.json'}, scene0000_00/0, object 0: ")


def test_objects_out_of_view_are_left_out(root):
    behind = scan2cad_model(rigid(9, (-500.0, 0, 0)))
    edit(root, lambda scans: [{**scans[0], "aligned_models": [behind]}])
    photo = Scan2CAD(root)[0]
    assert photo.objects == () == photo.problems


def test_a_bad_object_does_not_stop_the_others(root, caplog):
    def spoil(scans):
        good = scans[0]["aligned_models"][0]
        bad = [
            replaced(good, "trs.scale.1", 0.0),
            replaced(good, "trs.rotation", [0, 0, 0, 0]),
            replaced(good, "id_cad", ...),
            replaced(good, "sym", "__SYM_ODD"),
            replaced(good, "keypoints_scan.position", [1.0, 2.0]),
            7,
        ]
        return [{**scans[0], "aligned_models": [*bad, good]}]

    edit(root, spoil)
    dataset = Scan2CAD(root)
    with caplog.at_level(logging.WARNING, logger="cadalign"):
        photos = list(dataset)
    assert [photo.objects[0].object_id for photo in photos] == ["6", "6"]
    assert len(photos[0].problems) == 6
    assert len(dataset.problems) == 12
    assert "trs.scale[1]" in str(photos[0].problems[0])
    assert str(root / "full_annotations.json") in str(photos[0].problems[0])
    assert "left out" in caplog.text


def test_bad_scans_and_frames_do_not_stop_the_others(root):
    edit(root, lambda scans: [{"id_scan": 3}, "x", {"id_scan": "scene0000_00"}, *scans])
    (root / "scans/scene0000_00/pose/1.txt").write_text("-inf " * 4 + "\n")
    dataset = Scan2CAD(root)
    assert list(dataset.problems) == ["[0]", "[1]", "[2]"]
    assert [photo.name for photo in dataset] == ["scene0000_00/0"]
    assert list(dataset.problems)[3:] == ["scene0000_00/1"]
    with pytest.raises(DataError, match=r"1\.txt"):
        dataset[1]


def test_the_samples_of_one_scan_and_frames_beside_each_other(root, tmp_path):
    samples = tmp_path / "other" / "samples"
    scene = root / "scans" / "scene0000_00"
    write_text(samples / "annot.json", (root / "full_annotations.json").read_text())
    write_photo(samples / "scannet_0000_00_7.jpg")
    write_text(samples / "scannet_0000_00_7_pose.txt", (scene / "pose/0.txt").read_text())
    intrinsics = (scene / "intrinsic/intrinsic_color.txt").read_text()
    write_text(samples / "scannet_0000_00_intr.txt", intrinsics)
    dataset = cadalign.datasets.open(samples.parent)
    assert isinstance(dataset, Scan2CAD)
    assert dataset.names == ("scene0000_00/7",)
    with pytest.raises(DataError, match="there is no mesh of this model"):
        dataset[0].objects[0].model.load_mesh()


def test_folders_of_frames_and_models_may_be_links(root, tmp_path):
    elsewhere = write_text(
        tmp_path / "b" / "full_annotations.json", (root / "full_annotations.json").read_text()
    ).parent
    with pytest.raises(DataError, match="no frames of the 1 annotated scans"):
        Scan2CAD(elsewhere)
    for name in ("scans", "ShapeNetCore.v2"):
        (elsewhere / name).symlink_to(root / name)
    assert Scan2CAD(elsewhere)[0].objects[0].model.load_mesh() is not None


@pytest.mark.parametrize("content", ["", "[{", "{}", '[{"id_scan": "scene0000_00"', "\x00", "nul"])
def test_annotations_cut_short_are_reported(root, content):
    path = root / "full_annotations.json"
    path.write_text(content)
    with pytest.raises(DataError, match=r"full_annotations\.json"):
        Scan2CAD(root)


def test_damaged_files_are_reported(tmp_path):
    write_scan2cad(tmp_path, frames=1)
    assert_damage_is_told(tmp_path)


def test_the_sample_has_the_known_truth(real_data):
    folder = real_data / "real" / "scan2cad"
    known = json.loads((folder / "truth.json").read_text())
    (photo,) = cadalign.datasets.open(folder)
    found = {each.model.model_id[:8]: each for each in photo.objects}
    for name, values in known.items():
        pose = found[name].truth.cam_from_model
        np.testing.assert_allclose(pose.scale, values["scale_metric"], rtol=1e-6)
        np.testing.assert_allclose(pose.translation, values["translation_m"], atol=1e-6)
        np.testing.assert_allclose(pose.rotation, values["cam_from_model_rotation"], atol=1e-5)
        points = found[name].model.load_keypoints()
        rows = [points.names.index(each) for each in found[name].keypoints.names]
        gaps = photo.camera.project(pose.apply(points.xyz[rows])) - found[name].keypoints.points_2d
        assert np.median(np.linalg.norm(gaps, axis=1)) < 12
        mesh = found[name].model.load_mesh()
        np.testing.assert_allclose(mesh.bounds, found[name].model.bounds, atol=1e-5)
