"""Objectron: protocol buffers and JSON, the sensor on its side, frames of videos."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
from support.files import write_json
from support.photo_data import assert_damage_is_told, message, rigid, write_photo, write_text

import cadalign.datasets
from cadalign.datasets import Objectron
from cadalign.datasets.photos.objectron import read_video_frame
from cadalign.datasets.photos.objectron_files import decode, read_sequence
from cadalign.errors import DataError, InputError

SCALE = [0.2, 0.5, 0.3]
# Of a sensor of 640 x 480 px on its side: the upright photo is 480 x 640.
PROJECTION = np.array(
    [[1.6, 0, 0.02, 0], [0, 2.1, -0.01, 0], [0, 0, -1, -0.002], [0, 0, -1, 0]], dtype=float
)
BOX = np.array([[0, 0, 0], *np.ndindex(2, 2, 2)], dtype=float)
BOX[1:] -= 0.5


def cases():
    """View matrix, and the object's world pose, 1 m in front of a camera that looks along -z."""
    view = rigid(6, (0.3, 0.2, 0.1))
    view_from_object = rigid(7, (0.05, -0.03, -1.0))
    return view, np.linalg.inv(view) @ view_from_object


def projected():
    """The box's points in the upright photo, 0 to 1, as Objectron's tutorial projects them."""
    view, world = cases()
    points = np.column_stack([BOX * SCALE, np.ones(9)])
    clip = points @ world.T @ view.T @ PROJECTION.T
    ndc = clip[:, :2] / clip[:, 3:]
    return (1 + ndc[:, ::-1]) / 2


def floats(array):
    return np.ravel(array).astype(float).tolist()


def sequence_bytes(*, frames=2, **changes):
    """A sequence's protocol buffer."""
    view, world = cases()
    keypoints = [
        (2, message((1, number), (3, message((1, float(x)), (2, float(y)), (3, 1.0)))))
        for number, (x, y) in enumerate(projected())
    ]
    annotation = message((1, 1), *changes.get("keypoints", keypoints), (3, 0.9))
    camera = message((5, 640), (6, 480), (8, floats(PROJECTION)), (9, floats(view)), (7, [1.0] * 9))
    found = message(
        (1, 1),
        (2, "cup"),
        (4, floats(world[:3, :3])),
        (5, floats(world[:3, 3])),
        (6, changes.get("scale", SCALE)),
    )
    frame = message((2, annotation), (3, camera), (5, [0.0, 0.0, 0.0]))
    return message((1, found), *((2, message((1, number * 3)) + frame) for number in range(frames)))


def sequence_json():
    """The same as protobuf's MessageToJson writes it."""
    view, world = cases()
    keypoints = [
        {"id": number, "point2d": {"x": x, "y": y, "depth": 1.0}}
        for number, (x, y) in enumerate(projected().tolist())
    ]
    camera = {
        "imageResolutionWidth": 640,
        "imageResolutionHeight": 480,
        "projectionMatrix": floats(PROJECTION),
        "viewMatrix": floats(view),
    }
    found = {
        "id": 1,
        "category": "cup",
        "rotation": floats(world[:3, :3]),
        "translation": floats(world[:3, 3]),
        "scale": SCALE,
    }
    annotations = [{"objectId": 1, "keypoints": keypoints, "visibility": 0.9}]
    frame = {"frameId": 0, "annotations": annotations, "camera": camera}
    return {"objects": [found], "frameAnnotations": [frame]}


def write_bytes(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("form", ["pbdata", "json"])
def test_the_truth_projects_to_the_annotated_keypoints(tmp_path, form):
    path = tmp_path / "annotations" / "cup" / "batch-1" / f"3.{form}"
    if form == "json":
        write_json(path, sequence_json())
    else:
        write_bytes(path, sequence_bytes())
    dataset = cadalign.datasets.open(tmp_path)
    assert isinstance(dataset, Objectron)
    assert len(dataset) == (1 if form == "json" else 2)
    photo = dataset[0]
    assert (photo.camera.width, photo.camera.height) == (480, 640)
    (cup,) = photo.objects
    points = cup.model.load_keypoints()
    assert points.names == cup.keypoints.names
    assert points.names[:2] == ("center", "corner 1")
    pixels = photo.camera.project(cup.truth.cam_from_model.apply(points.xyz))
    np.testing.assert_allclose(pixels, cup.keypoints.points_2d, atol=2e-3)
    np.testing.assert_allclose(cup.keypoints.points_2d + 0.5, projected() * [480, 640], atol=2e-3)
    np.testing.assert_allclose(cup.truth.cam_from_model.scale, SCALE, atol=1e-6)
    np.testing.assert_allclose(cup.truth.box.extents, SCALE, atol=1e-6)
    assert cup.truth.cam_from_model.translation[2] == pytest.approx(1.0, abs=1e-6)
    assert cup.category == "cup"
    assert cup.visible_fraction == pytest.approx(0.9)


def test_images_are_frames_in_a_folder_or_of_the_video(tmp_path):
    write_bytes(tmp_path / "annotations" / "cup" / "batch-1" / "3.pbdata", sequence_bytes())
    write_photo(tmp_path / "annotations" / "cup" / "batch-1" / "3" / "3.jpg", 480, 640)
    dataset = Objectron(tmp_path)
    assert [photo.image is not None for photo in dataset] == [False, True]
    assert dataset[1].read_image().shape == (640, 480, 3)
    video = tmp_path / "videos" / "cup" / "batch-1" / "3" / "video.MOV"
    video.parent.mkdir(parents=True)
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 48))
    assert writer.isOpened()
    writer.write(np.full((48, 64, 3), 100, np.uint8))
    writer.release()
    photo = dataset[0]
    assert photo.read_image().shape == (64, 48, 3)
    video.write_bytes(b"x")
    with pytest.raises(DataError, match=r"video\.MOV"):
        photo.read_image()


def test_bad_files_frames_and_objects_do_not_stop_the_others(tmp_path):
    good = sequence_bytes()
    write_bytes(tmp_path / "good.pbdata", good)
    write_bytes(tmp_path / "short.pbdata", good[:-30])
    write_bytes(tmp_path / "empty.pbdata", b"")
    write_bytes(tmp_path / "text.pbdata", b"this is no protocol buffer")
    write_bytes(tmp_path / "flat.pbdata", sequence_bytes(scale=[0.0, 1.0, 1.0]))
    write_bytes(tmp_path / "few.pbdata", sequence_bytes(keypoints=[]))
    write_bytes(tmp_path / "noframe.pbdata", good + message((2, message((1, 5)))))
    write_text(tmp_path / "annotations" / "x.json", '{"frames": 3}')
    dataset = Objectron(tmp_path)
    photos = {photo.name: photo for photo in dataset}
    assert sorted(photos) == ["few/0", "few/1", "flat/0", "flat/1", "good/0", "good/1",
                              "noframe/0", "noframe/1"]  # fmt: skip
    assert len(photos["good/1"].objects) == 1
    assert photos["flat/0"].objects == photos["few/0"].objects == ()
    assert "is not positive" in str(photos["flat/0"].problems[0])
    assert "expected 9" in str(photos["few/0"].problems[0])
    assert "camera" in str(dataset.problems["noframe/2"])
    for name in ("short.pbdata", "empty.pbdata", "text.pbdata", "annotations/x.json"):
        assert name in str(dataset.problems[str(tmp_path / name)])
    for name in ("good", "noframe"):
        (tmp_path / f"{name}.pbdata").unlink()


def test_no_readable_file_is_refused(tmp_path):
    with pytest.raises(DataError, match="no annotation files"):
        Objectron(tmp_path)
    write_bytes(tmp_path / "short.pbdata", sequence_bytes()[:100])
    with pytest.raises(DataError, match="cut short"):
        Objectron(tmp_path)


def test_every_truncation_of_a_file_is_told(tmp_path):
    good = sequence_bytes(frames=1)
    for length in range(0, len(good), 7):
        path = write_bytes(tmp_path / "x.pbdata", good[:length])
        with pytest.raises(DataError, match=r"x\.pbdata"):
            read_sequence(path).frame(0)


def test_damaged_files_are_told(tmp_path):
    write_bytes(tmp_path / "annotations" / "cup" / "batch-1" / "3.pbdata", sequence_bytes())
    write_json(tmp_path / "annotations" / "cup" / "batch-1" / "4.json", sequence_json())
    write_photo(tmp_path / "annotations" / "cup" / "batch-1" / "3" / "3.jpg", 48, 64)
    assert_damage_is_told(tmp_path)


def test_decoding_follows_the_wire_format():
    """From the documentation of the encoding: field 1 = 150 is 08 96 01; -1 takes ten bytes."""
    fields = {1: ("a", "int"), 4: ("e", ["int"]), 2: ("b", "text")}
    assert decode(bytes.fromhex("089601"), fields) == {"a": 150, "e": []}
    assert decode(bytes.fromhex("08" + "ff" * 9 + "01"), fields)["a"] == -1
    assert decode(bytes.fromhex("120774657374696e67"), fields)["b"] == "testing"
    assert decode(bytes.fromhex("2206038e029ea705"), fields)["e"] == [3, 270, 86942]
    with pytest.raises(InputError, match="cut short"):
        decode(bytes.fromhex("12077465"), fields)
    with pytest.raises(InputError):
        decode(bytes.fromhex("0b01"), fields)


def test_videos_are_not_lists_of_other_files(tmp_path):
    path = tmp_path / "video.MOV"
    path.write_text("#EXTM3U\n#EXTINF:1,\n/etc/passwd\n")
    with pytest.raises(DataError, match=r"video\.MOV: not a video in QuickTime's or MP4's form"):
        read_video_frame(path, 0)
    os.remove(path)
    os.mkfifo(path)
    with pytest.raises(DataError, match=r"video\.MOV: not a regular file"):
        read_video_frame(path, 0)


def test_files_without_frames_are_refused(tmp_path):
    write_json(tmp_path / "annotations" / "a.json", {"objects": [], "frameAnnotations": []})
    with pytest.raises(DataError, match="the annotation files have no frames"):
        Objectron(tmp_path)
