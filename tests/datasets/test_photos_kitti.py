"""KITTI: both benchmarks' labels, calibration, and files of keypoints."""

from __future__ import annotations

import time

import numpy as np
import pytest
from support.files import write_json
from support.photo_data import assert_damage_is_told, write_photo, write_text

import cadalign.datasets
from cadalign import Camera, ShapeModel
from cadalign.datasets import KittiCars
from cadalign.datasets.photos.kitti_keypoints import car_box, car_keypoints, yaw_of_car
from cadalign.errors import DataError

P2 = "P2: 700 0 600 70 0 700 170 7 0 0 1 0.5\n"
# Height 1.5, width 1.6, length 4; bottom centre at x = 2, y = 1.7, z = 20.
CAR = "Car 0.00 1 -1.5 100 50 200 150 1.5 1.6 4.0 2.0 1.7 20.0 0.0"


def test_the_box_of_a_car_heading_to_the_right(tmp_path):
    """At rotation_y = 0 a car heads along the camera's x: its front is right, its left is far."""
    box = car_box(np.array([1.5, 1.6, 4.0]), np.array([2.0, 1.7, 20.0]), 0.0)
    np.testing.assert_allclose(box.center, [2.0, 0.95, 20.0])
    front, up, left = box.rotation @ [0, -1, 0], box.rotation @ [0, 0, 1], box.rotation @ [1, 0, 0]
    np.testing.assert_allclose(front, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(up, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(left, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(box.corners.min(axis=0), [0.0, 0.2, 19.2])
    np.testing.assert_allclose(box.corners.max(axis=0), [4.0, 1.7, 20.8])


@pytest.mark.parametrize("yaw", [-3.0, -1.5, 0.0, 0.3, 2.9])
def test_the_yaw_follows_from_the_box(yaw):
    assert yaw_of_car(car_box(np.ones(3), np.zeros(3), yaw).rotation) == pytest.approx(yaw)


def test_keypoints_of_a_car_are_known_but_for_what_its_lengths_leave_open():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    mean = np.vstack([corners * [0.8, 2.0, 0.75], [[0.3, 0.5, 0.2]]])
    longer = mean * [0, 1, 0]
    shape = ShapeModel.from_basis(mean, [longer], [0.1], residual_sigma=0.03)
    camera = Camera(1242, 375, 700.0, 700.0, 620.5, 187.0)
    box = car_box(np.array([1.5, 1.6, 1.2 * 4.0]), np.array([2.0, 1.7, 20.0]), -1.5)
    found = car_keypoints(shape, box, camera)
    in_camera = (mean * [1, 1.2, 1]) @ box.rotation.T + box.center
    np.testing.assert_allclose(found.points_2d, camera.project(in_camera), atol=0.5)
    inside = 700 * 0.03 / in_camera[-1, 2]  # of the last, which no length depends on
    assert found.sigma[-1] == pytest.approx(inside, rel=0.03)


def test_labels_of_the_object_benchmark(tmp_path):
    folder = tmp_path / "training"
    lines = [CAR, "DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10", CAR + " 0.9"]
    write_text(folder / "label_2" / "000007.txt", "\n".join([*lines, CAR.replace("Car", "Van")]))
    write_text(folder / "calib" / "000007.txt", "P0: 1\n" + P2)
    write_photo(folder / "image_2" / "000007.png", 1224, 370)
    (photo,) = dataset = cadalign.datasets.open(tmp_path)
    assert isinstance(dataset, KittiCars)
    assert (photo.camera.width, photo.camera.fx, photo.camera.cy) == (1224, 700, 170)
    assert [each.object_id for each in photo.objects] == ["0", "2"]
    car = photo.objects[0]
    assert car.flags == {"occluded"}
    np.testing.assert_array_equal(car.bbox, [100, 50, 200, 150])
    # P2's last column is K (x, y, 0.5): x = (70 - 300) / 700, y = (7 - 85) / 700.
    shift = [-230 / 700, -78 / 700, 0.5]
    np.testing.assert_allclose(car.truth.box.center, np.add([2.0, 0.95, 20.0], shift))
    # The same as projecting the label's location by P2.
    matrix = np.array(P2.split()[1:], dtype=float).reshape(3, 4)
    u, v, w = matrix @ [2.0, 0.95, 20.0, 1.0]
    np.testing.assert_allclose(photo.camera.project([car.truth.box.center]), [[u / w, v / w]])
    for one in (("Van",), "Van"):
        assert len(KittiCars(tmp_path, categories=one)[0].objects) == 1


def test_labels_of_the_tracking_benchmark(tmp_path):
    lines = [f"0 5 {CAR}", f"2 5 {CAR}", f"2 6 {CAR}"]
    write_text(tmp_path / "label_02" / "0010.txt", "\n".join(lines))
    write_text(tmp_path / "calib" / "0010.txt", P2)
    write_photo(tmp_path / "image_02" / "0010" / "000002.png", 1242, 375)
    photos = {photo.name: photo for photo in KittiCars(tmp_path)}
    assert sorted(photos) == ["0010/000000", "0010/000002"]
    assert [each.object_id for each in photos["0010/000002"].objects] == ["5", "6"]
    assert photos["0010/000000"].image is None
    assert photos["0010/000000"].camera.width == 1242


def car_entry(**changes):
    entry = {
        "image": "images/2_98.png",
        "K": [[700, 0, 600], [0, 700, 170], [0, 0, 1]],
        "bbox": [100, 50, 200, 150],
        "dims_hwl": [1.5, 1.6, 4.0],
        "location_bottom_centre": [2.0, 1.7, 20.0],
        "rotation_y": 0.0,
        "keypoints": [
            {"name": "roof", "xyz": [0, 0, 0.5], "uv": [150, 60], "score": 0.7},
            {"name": "wheel", "xyz": [1, 0, -0.5], "uv": [110, 140], "score": 0.05},
        ],
    }
    return {**entry, **changes}


def test_keypoint_files(tmp_path):
    bad = [7, car_entry(rotation_y="x"), car_entry(dims_hwl=[1.5, 0, 4])]
    write_json(tmp_path / "cars.json", [car_entry(), *bad, car_entry(image="none.png")])
    write_photo(tmp_path / "images" / "2_98.png", 1242, 375)
    frame = {key: car_entry()[key] for key in ("bbox", "location_bottom_centre", "rotation_y")}
    track = {
        "sequence": 10,
        "track": 3,
        **{key: car_entry()[key] for key in ("K", "dims_hwl")},
        "frames": [{**frame, "frame": 0, "uv": [[1, 2]], "score": [0.5]}, {"frame": 1}],
    }
    tracks = {"names": ["roof"], "model_xyz": [[0, 0, 0.5]], "tracks": [track, {"frames": []}]}
    write_json(tmp_path / "car_tracks.json", tracks)
    dataset = cadalign.datasets.open(tmp_path)
    photos = list(dataset)
    assert [photo.name for photo in photos] == ["2_98#0", "none#4", "10/track 3/0"]
    assert len(dataset.problems) == 5
    car = photos[0].objects[0]
    np.testing.assert_array_equal(car.keypoints.visible, [True, False])
    np.testing.assert_array_equal(car.keypoints.scores, [0.7, 0.05])
    assert car.model.load_keypoints().names == ("roof", "wheel")
    np.testing.assert_allclose(car.truth.box.center, [2.0, 0.95, 20.0])
    with pytest.raises(DataError, match="no mesh"):
        car.model.load_mesh()
    assert photos[1].image is None
    assert photos[2].objects[0].object_id == "3"


def test_bad_lines_and_calibrations_do_not_stop_the_others(tmp_path):
    write_text(tmp_path / "label_2" / "0.txt", f"{CAR}\nCar 1 2\n{CAR} 1 2 3\n{CAR[:-3]}nan\n")
    write_text(tmp_path / "label_2" / "1.txt", CAR)
    write_text(tmp_path / "label_2" / "2.txt", "Car 0 0 0 1 2 3 4 0 1 1 0 0 9 0\n" + CAR)
    write_text(tmp_path / "calib" / "1.txt", "P2: 700 0 600\n")
    write_text(tmp_path / "label_02" / "0003.txt", f"0 1 {CAR}\nx y {CAR}\n")
    dataset = KittiCars(tmp_path)
    photos = {photo.name: photo for photo in dataset}
    assert sorted(photos) == ["0", "0003/000000", "2"]
    assert len(photos["0"].objects) == 1
    assert photos["0"].camera is None
    where = str(tmp_path / "label_2" / "0.txt")
    assert [each.where for each in photos["0"].problems] == [
        f"{where}, line {n}" for n in (2, 3, 4)
    ]
    assert len(photos["2"].objects) == 1
    text = " ".join(map(str, dataset.problems.values()))
    assert "P2 is not a 3 x 4 matrix" in text
    assert "0003.txt, line 2" in text


@pytest.mark.slow
def test_damaged_files_are_told(tmp_path):
    write_text(tmp_path / "label_2" / "0.txt", CAR)
    write_text(tmp_path / "calib" / "0.txt", P2)
    write_photo(tmp_path / "image_2" / "0.png")
    write_text(tmp_path / "label_02" / "0003.txt", f"0 1 {CAR}\n1 1 {CAR}\n")
    write_json(tmp_path / "cars.json", [car_entry()])
    assert_damage_is_told(tmp_path)


@pytest.mark.long
def test_ten_thousand_labels_take_little_time(tmp_path):
    lines = [f"{number} 1 {CAR if number % 100 != 7 else CAR[:20]}" for number in range(10_000)]
    write_text(tmp_path / "label_02" / "0003.txt", "\n".join(lines))
    begin = time.process_time()
    summary = KittiCars(tmp_path).summary()
    assert time.process_time() - begin < 60
    assert (summary.photos, summary.objects, len(summary.problems)) == (9900, 9900, 100)


def test_a_folder_without_labels_is_refused(tmp_path):
    with pytest.raises(DataError, match="no KITTI labels"):
        KittiCars(tmp_path)
    write_text(tmp_path / "cars.json", "[{")
    with pytest.raises(DataError, match=r"cars\.json"):
        KittiCars(tmp_path)


@pytest.mark.long
def test_the_mean_car_in_the_true_box_lies_on_the_sample_keypoints(real_data):
    dataset = cadalign.datasets.open(real_data / "real" / "kitti_cars")
    gaps = []
    for photo in dataset:
        for car in photo.objects:
            if car.keypoints is None:
                continue
            seen = car.keypoints.visible
            box, points = car.truth.box, car.model.load_keypoints().xyz[seen]
            pixels = photo.camera.project(points @ box.rotation.T + box.center)
            gaps.append(np.median(np.linalg.norm(pixels - car.keypoints.points_2d[seen], axis=1)))
    assert len(gaps) == 62
    assert np.median(gaps) < 8
    assert sum(photo.image is not None for photo in dataset) == 3


def test_angles_beyond_all_turns_give_a_box() -> None:
    dims, place = np.array([1.5, 1.7, 4.2]), np.array([1.0, 1.6, 20.0])
    whole = car_box(dims, place, 0.3 + 4 * np.pi)
    np.testing.assert_allclose(whole.rotation, car_box(dims, place, 0.3).rotation, atol=1e-12)
    assert np.isfinite(car_box(dims, place, 1e300).rotation).all()
