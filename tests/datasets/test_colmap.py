"""COLMAP models: their content, reprojection of a real one, errors that name bad images."""

from __future__ import annotations

import logging
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from support.files import exact
from support.problems import assert_drawn_stretches_are_recovered

from cadalign.datasets import Colmap, Correspondences
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

DATA = os.environ.get("CADALIGN_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="CADALIGN_DATA is unset")

PARAMS = {
    "SIMPLE_PINHOLE": [500, 320, 240],
    "PINHOLE": [500, 510, 321, 242],
    "SIMPLE_RADIAL": [500, 320, 240, -0.1],
    "RADIAL": [500, 320, 240, -0.1, 0.02],
    "OPENCV": [500, 510, 321, 242, -0.1, 0.02, 0.001, -0.002],
    "OPENCV_FISHEYE": [500, 510, 321, 242, 0.1, 0, 0, 0],
    "FULL_OPENCV": [500, 510, 321, 242, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003],
    "FOV": [500, 510, 321, 242, 0.9],
    "SIMPLE_RADIAL_FISHEYE": [500, 320, 240, -0.01],
    "RADIAL_FISHEYE": [500, 320, 240, -0.01, 0.002],
    "THIN_PRISM_FISHEYE": [500, 510, 321, 242, 0.1, 0.02, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003],
    "RAD_TAN_THIN_PRISM_FISHEYE": [500, 510, 321, 242, *[0.0] * 12],
}


class Model:
    """A model's parts as plain values, to be changed by tests and written."""

    def __init__(self, models: list[str], *, points: int = 30) -> None:
        rng = np.random.default_rng(4)
        # Ids with gaps and out of order, as in COLMAP's files.
        ids = rng.permutation(np.arange(7, 7 + 3 * points, 3))
        self.points = {int(i): rng.uniform(-1, 1, 3) for i in ids}
        self.cameras = {
            10 + i: [model, 640, 480, [float(v) for v in PARAMS[model]]]
            for i, model in enumerate(models)
        }
        self.images = []
        for number, camera_id in enumerate(self.cameras):
            quat = rng.normal(size=4)
            quat /= np.linalg.norm(quat)
            translation = rng.normal(size=3)
            translation[2] += 6
            seen = rng.choice(list(self.points), size=points - 5, replace=False)
            observations = [(*rng.uniform(0, 400, 2).tolist(), int(i)) for i in seen]
            observations.insert(3, (1.5, 2.5, -1))
            name = f"{number}.jpg"
            self.images.append([9 - number, quat, translation, camera_id, name, observations])

    def write(self, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        cameras = ["# Camera list"]
        for number, (model, width, height, params) in self.cameras.items():
            cameras.append(f"{number} {model} {width} {height} {exact(params)}")
        images = ["# Image list"]
        for number, quat, translation, camera_id, name, observations in reversed(self.images):
            images.append(f"{number} {exact(quat)} {exact(translation)} {camera_id} {name}")
            images.append(" ".join(f"{x!r} {y!r} {i}" for x, y, i in observations))
        points = ["# 3D point list"]
        points += [f"{i} {exact(xyz)} 1 2 3 0.5 1 2 3 4" for i, xyz in self.points.items()]
        for stem, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
            (folder / f"{stem}.txt").write_text("\n".join(lines) + "\n")
        return folder


def assert_same(one: Correspondences, other: Correspondences) -> None:
    assert (one.id, one.camera, one.cam_from_world) == (
        other.id,
        other.camera,
        other.cam_from_world,
    )
    for name in ("points_3d", "points_2d"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


# --- what the files say


def test_written_models_are_read(tmp_path):
    model = Model(["PINHOLE", "OPENCV"])
    _, _, translation, _, name, observations = model.images[1]
    seen = Colmap(model.write(tmp_path))[name]
    kept = [entry for entry in observations if entry[2] != -1]
    np.testing.assert_array_equal(seen.points_3d, [model.points[i] for _, _, i in kept])
    # COLMAP's pixel centres are at (0.5, 0.5), for observations and principal point alike.
    np.testing.assert_allclose(seen.points_2d, [(x - 0.5, y - 0.5) for x, y, _ in kept])
    expected = Camera(640, 480, 500, 510, 320.5, 241.5, (-0.1, 0.02, 0.001, -0.002))
    assert seen.camera == expected
    np.testing.assert_array_equal(seen.cam_from_world.translation, translation)
    assert seen.cam_from_world.scale.tolist() == [1, 1, 1]


def test_quaternions_are_scalar_first_and_cam_from_world(tmp_path):
    model = Model(["PINHOLE"])
    model.images[0][1] = np.array([1.0, 1.0, 0.0, 0.0])  # 90 degrees about x, not normalised
    rotation = Colmap(model.write(tmp_path))[0].cam_from_world.rotation
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)


@pytest.mark.parametrize("folder", ["", "sparse/0"])
def test_a_model_is_found_in_subfolders(tmp_path, folder):
    Model(["PINHOLE"]).write(tmp_path / folder)
    assert Colmap(tmp_path).names == ("0.jpg",)


def test_images_without_observations_are_empty(tmp_path):
    model = Model(["PINHOLE", "PINHOLE", "PINHOLE"])
    for image in model.images[:2]:  # one of them is last in the text file
        image[5] = []
    images = Colmap(model.write(tmp_path))
    assert not images.problems
    assert [len(image) for image in images] == [0, 0, 25]


def test_names_with_spaces_and_crlf_lines_are_read(tmp_path):
    model = Model(["PINHOLE"])
    model.images[0][4] = "a folder/my photo.jpg"
    file = model.write(tmp_path) / "images.txt"
    file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n"))
    assert Colmap(tmp_path)["a folder/my photo.jpg"].points_2d.shape == (25, 2)


# --- the sequence


def test_models_can_be_sent_to_worker_processes(tmp_path):
    images = Colmap(Model(["PINHOLE", "RADIAL"]).write(tmp_path))
    for one, other in zip(images, pickle.loads(pickle.dumps(images)), strict=True):
        assert_same(one, other)


def test_one_bad_image_spoils_no_other(tmp_path, caplog):
    model = Model(["PINHOLE"] * 3)
    model.images[1][5][0] = (1.0, 2.0, 999)
    images = Colmap(model.write(tmp_path))
    with caplog.at_level(logging.WARNING, logger="cadalign"):
        assert [image.id for image in images] == ["0.jpg", "2.jpg"]
        assert len(list(images)) == 2
    assert len(caplog.records) == 1
    assert list(images.problems) == ["1.jpg"]
    assert images[2].id == "2.jpg"


# --- bad input: exact messages for what the format's own checks find


def test_observing_points_that_do_not_exist_names_file_image_and_point(tmp_path):
    model = Model(["PINHOLE"] * 2)
    model.images[1][5][0] = (1.0, 2.0, 999)
    model.images[1][5][1] = (1.0, 2.0, 8)
    images = Colmap(model.write(tmp_path))
    with pytest.raises(DataError) as caught:
        images["1.jpg"]
    assert caught.value.where == f"{images.root}, 1.jpg"
    assert "2 of the points that it observes do not exist, the first is point 8" in str(
        caught.value
    )


@pytest.mark.parametrize("name", ["FOV", "RAD_TAN_THIN_PRISM_FISHEYE", "THIN_PRISM_FISHEYE"])
def test_unknown_camera_model_concerns_its_images_only(tmp_path, name):
    images = Colmap(Model([name, "PINHOLE"]).write(tmp_path))
    assert len(images[1]) == 25
    with pytest.raises(
        DataError, match=rf"camera 10.*unknown model '{name}'.*for others undistort the images"
    ):
        images[0]


def test_a_text_file_cut_short_names_the_image(tmp_path):
    file = Model(["PINHOLE"] * 2).write(tmp_path) / "images.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:-1], lines[-1].rsplit(maxsplit=1)[0]]))
    images = Colmap(tmp_path)
    assert images[1].id == "1.jpg"
    with pytest.raises(DataError, match=r"image 0.jpg: the observations have 77 values"):
        images[0]
    file.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(DataError, match=r"image 0.jpg: the file ends before its observations"):
        Colmap(tmp_path)["0.jpg"]


@pytest.mark.parametrize(
    ("name", "line", "message"),
    [
        ("cameras.txt", "11 PINHOLE 640", "line 3: '11 PINHOLE 640' is malformed; expected CAMERA"),
        ("cameras.txt", "10 PINHOLE 6 4 1 1 1 1", "line 3: camera 10 occurs twice"),
        ("points3D.txt", "1 0 zero 0 1 2 3 0.5", "line 32: '1 0 zero 0 1 2 3 0.5' is malformed"),
        ("points3D.txt", "7 0 0 0 1 2 3 0.5", "point 7 occurs twice"),
        ("points3D.txt", f"{2**63} 0 0 0 1 2 3 0.5", "line 32: '9223372036854775808 0 0 0 1 2 3 0"),
        ("images.txt", "1 1 0 0 0", "line 4: '1 1 0 0 0' is malformed; expected IMAGE_ID"),
        ("images.txt", "1 1 0 0 0 1 2 3 10 0.jpg\n", "the image '0.jpg' occurs twice"),
    ],
)
def test_malformed_text_names_the_line(tmp_path, name, line, message):
    folder = Model(["PINHOLE"]).write(tmp_path)
    with (folder / name).open("a") as file:
        file.write(line + "\n")
    with pytest.raises(DataError) as caught:
        Colmap(folder)
    assert message in str(caught.value)
    assert name in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (1, np.zeros(4), "is not a rotation"),
        (1, np.full(4, np.nan), "is not a rotation"),
        (2, np.array([0, np.inf, 0]), "NaN or infinite"),
        (3, 77, "there is no camera 77"),
        (5, [(np.nan, 1.0, 7)], "NaN or infinite values in row 0"),
    ],
)
def test_bad_values_name_the_image(tmp_path, column, value, message):
    model = Model(["PINHOLE", "PINHOLE"])
    model.images[1][column] = value
    images = Colmap(model.write(tmp_path))
    assert images[0].id == "0.jpg"
    with pytest.raises(DataError, match=message) as caught:
        images[1]
    assert ", 1.jpg" in str(caught.value.where)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        Colmap(tmp_path / "nowhere")
    (tmp_path / "cameras.bin").touch()
    with pytest.raises(DataError, match=r"images.txt, points3D.txt are missing; .*model_converter"):
        Colmap(tmp_path)
    (Model(["PINHOLE"]).write(tmp_path / "sparse/0") / "points3D.txt").unlink()
    with pytest.raises(DataError, match=r"sparse/0: points3D.txt is missing"):
        Colmap(tmp_path)


# --- Correspondences


def test_correspondences_are_checked_and_cannot_be_changed():
    camera = Camera(64, 48, 50, 50, 31.5, 23.5)
    pose = Alignment(np.eye(3), [0, 0, 2], [1, 1, 1])
    points = np.zeros((3, 3))
    seen = Correspondences("a", points, np.ones((3, 2)), camera, pose)
    points[0] = 7  # the caller's array stays the caller's
    assert seen.points_3d[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        seen.points_2d[0] = 0
    with pytest.raises(InputError, match="points_2d: 2 rows"):
        Correspondences("a", points, np.ones((2, 2)), camera, pose)
    with pytest.raises(InputError, match="does not stretch"):
        Correspondences(
            "a", points, np.ones((3, 2)), camera, Alignment(np.eye(3), [0, 0, 2], [1, 2, 1])
        )


# --- the real model


@needs_data
def test_real_model_reprojects():
    images = list(Colmap(Path(DATA) / "sfm/maupertuis_colmap"))
    assert [image.id for image in images] == ["00.jpg", "01.jpg", "02.jpg", "03.jpg"]
    assert sum(len(image) for image in images) == 3355
    errors = np.concatenate([np.linalg.norm(image.residuals(), axis=1) for image in images])
    assert np.median(errors) < 0.26
    assert all(image.camera.contains(image.points_2d).all() for image in images)


@needs_data
def test_stretches_drawn_for_the_real_model_are_recovered():
    assert_drawn_stretches_are_recovered(Colmap(Path(DATA) / "sfm/maupertuis_colmap"))
