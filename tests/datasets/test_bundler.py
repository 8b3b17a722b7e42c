"""Bundler models: axes, pixels and lens arrive right, real ones reproject, bad ones are named."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.files import exact
from support.problems import assert_drawn_stretches_are_recovered
from support.timing import reference_seconds, timed

from cadalign.datasets import Bundler
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera

DATA = os.environ.get("CADALIGN_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="CADALIGN_DATA is unset")

WIDTH, HEIGHT = 641, 480


def rotation_about_y(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


class Model:
    """A scene seen by a few cameras, projected by Bundler's own formulas."""

    def __init__(self, cameras: int = 3, points: int = 12) -> None:
        rng = np.random.default_rng(2)
        self.points = rng.uniform(-1, 1, (points, 3))
        # focal, k1, k2, rotation, translation: the camera looks down -z, so the scene is at -z.
        self.cameras = [
            [500.0 + i, -0.1, 0.02, rotation_about_y(20 * i), np.array([0.1 * i, -0.2, -6.0])]
            for i in range(cameras)
        ]
        self.views = [
            [(camera, key, *self.project(camera, row)) for key, camera in enumerate(range(cameras))]
            for row in range(points)
        ]

    def project(self, camera: int, row: int) -> np.ndarray:
        """The manual: P = R X + t; p = -P / P.z; p' = f * r(p) * p."""
        focal, k1, k2, rotation, translation = self.cameras[camera]
        point = rotation @ self.points[row] + translation
        p = -point[:2] / point[2]
        return focal * (1 + k1 * (p @ p) + k2 * (p @ p) ** 2) * p

    def write(self, folder: Path, name: str = "bundle.out") -> Path:
        lines = ["# Bundle file v0.3", f"{len(self.cameras)} {len(self.points)}"]
        for focal, k1, k2, rotation, translation in self.cameras:
            lines += [exact([focal, k1, k2]), *(exact(row) for row in rotation), exact(translation)]
        for xyz, views in zip(self.points, self.views, strict=True):
            listed = " ".join(f"{camera} {key} {exact(xy)}" for camera, key, *xy in views)
            lines += [exact(xyz), "255 0 17", f"{len(views)} {listed}"]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("\n".join(lines) + "\n")
        return folder / name


def write_photo(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path)


# --- what the file says


def test_observations_reproject_in_cadaligns_axes_and_pixels(tmp_path):
    model = Model()
    images = Bundler(model.write(tmp_path), sizes=(WIDTH, HEIGHT))
    assert images.ids == ("0", "1", "2")
    for number, image in enumerate(images):
        focal = 500.0 + number
        assert image.camera == Camera(WIDTH, HEIGHT, focal, focal, 320, 239.5, (-0.1, 0.02, 0, 0))
        np.testing.assert_allclose(image.residuals(), 0, atol=1e-9)
        assert image.point_ids.tolist() == list(range(12))
        np.testing.assert_array_equal(image.points_3d, model.points)


def test_y_points_up_and_the_origin_is_the_middle_of_the_image(tmp_path):
    model = Model(cameras=1)
    model.views[5] = [(0, 0, 100.0, 50.0)]
    image = Bundler(model.write(tmp_path), sizes=(WIDTH, HEIGHT))[0]
    # The middle of the pixels' centres 0 ... w - 1 is (w - 1) / 2.
    np.testing.assert_allclose(image.points_2d[5], [320 + 100, 239.5 - 50])


def test_points_seen_by_some_cameras_only_go_to_those(tmp_path):
    model = Model()
    model.views[0] = []
    model.views[1] = model.views[1][2:]
    images = Bundler(model.write(tmp_path))
    assert [image.point_ids.tolist()[:2] for image in images] == [[2, 3], [2, 3], [1, 2]]


def test_photos_without_a_pose_are_left_out(tmp_path):
    model = Model()
    model.cameras[1] = [0.0, 0.0, 0.0, np.zeros((3, 3)), np.zeros(3)]
    images = Bundler(model.write(tmp_path))
    assert (images.ids, images.unplaced) == (("0", "2"), ("1",))
    assert not images.problems
    np.testing.assert_allclose(images["2"].residuals(), 0, atol=1e-9)


# --- names and sizes of photos


def test_names_and_sizes_come_from_the_list(tmp_path):
    for name in ("b.jpg", "a.jpg", "c.jpg"):
        write_photo(tmp_path / "photos" / name)
    (tmp_path / "list.txt").write_text("./photos/b.jpg 0 532.1\nphotos/a.jpg\nphotos/c.jpg 0 5\n")
    images = Bundler(Model().write(tmp_path / "bundle"))
    assert images.ids == ("photos/b.jpg", "photos/a.jpg", "photos/c.jpg")
    assert (images[0].camera.width, images[0].camera.height) == (WIDTH, HEIGHT)


def test_names_and_sizes_come_from_the_folder_images_in_order(tmp_path):
    for number, name in enumerate(("c.jpg", "a.jpg", "b.png")):
        write_photo(tmp_path / "images" / name, (700 + number, 600))
    (tmp_path / "images" / "notes.txt").touch()
    images = Bundler(Model().write(tmp_path, "model.out").parent)
    assert images.ids == ("a.jpg", "b.png", "c.jpg")
    assert [image.camera.width for image in images] == [701, 702, 700]


def test_without_photos_the_image_holds_all_observations(tmp_path):
    write_photo(tmp_path / "images" / "one.jpg")  # not as many as cameras
    model = Model()
    for image in Bundler(model.write(tmp_path)):
        assert image.camera.contains(image.points_2d).all()
        assert image.camera.width < 500
        np.testing.assert_allclose(image.residuals(), 0, atol=1e-9)


def test_sizes_may_be_given_one_by_one(tmp_path):
    file = Model().write(tmp_path)
    sizes = [(641, 480), (700, 500), (800, 600)]
    images = Bundler(file, sizes=sizes)
    assert [(image.camera.width, image.camera.height) for image in images] == sizes
    for wrong in (sizes[:2], (0, 480), (640.5, 480), "big"):
        with pytest.raises(InputError, match="sizes"):
            Bundler(file, sizes=wrong)


# --- bad input


def test_a_photo_of_another_size_concerns_that_image_only(tmp_path):
    for name, size in (("a.png", (641, 480)), ("b.png", (60, 48)), ("c.png", (641, 480))):
        write_photo(tmp_path / "images" / name, size)
    images = Bundler(Model().write(tmp_path))
    assert [image.id for image in images] == ["a.png", "c.png"]
    with pytest.raises(DataError, match=r"image b.png: observations reach .* 60 x 48; give the si"):
        images["b.png"]


def test_a_photo_that_cannot_be_read_is_named(tmp_path):
    for name in ("a.png", "b.png", "c.png"):
        write_photo(tmp_path / "images" / name)
    (tmp_path / "images" / "b.png").write_bytes(b"no picture")
    file = Model().write(tmp_path)
    assert list(Bundler(file).problems) == ["b.png"]
    with pytest.raises(DataError, match=r"b.png: not an image that can be read"):
        Bundler(file)[1]
    assert not Bundler(file, sizes=(WIDTH, HEIGHT)).problems


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (0, -500.0, "focal length is -500"),
        (1, np.nan, "not distortion coefficients"),
        (3, np.full((3, 3), 0.5), "not a rotation matrix"),
        (3, np.diag([1.0, 1.0, -1.0]), "not a rotation matrix"),
        (4, np.array([0, np.inf, 0]), "NaN or infinite"),
    ],
)
def test_bad_cameras_concern_their_image_only(tmp_path, column, value, message):
    model = Model()
    model.cameras[1][column] = value
    images = Bundler(model.write(tmp_path))
    assert [image.id for image in images] == ["0", "2"]
    with pytest.raises(DataError, match=message) as caught:
        images["1"]
    assert f"{images.source}, image 1" in str(caught.value.where)


@pytest.mark.parametrize("sizes", [None, (WIDTH, HEIGHT)])
def test_nan_observations_concern_their_image_only(tmp_path, sizes):
    model = Model()
    model.views[4][1] = (1, 0, np.nan, 3.0)
    images = Bundler(model.write(tmp_path), sizes=sizes)
    assert [image.id for image in images] == ["0", "2"]
    with pytest.raises(DataError, match=r"image 1, .*NaN or infinite"):
        images["1"]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("camera", [3, -1, 0.5, np.nan, np.inf])
def test_observations_in_cameras_that_do_not_exist_are_refused(tmp_path, camera):
    model = Model()
    model.views[7][1] = (camera, 0, 1.0, 3.0)
    with pytest.raises(
        DataError, match=r"bundle.out: point 7 is observed in camera .* there are 3"
    ):
        Bundler(model.write(tmp_path))


def test_a_file_cut_after_any_value_is_refused(tmp_path):
    file = Model(cameras=2, points=3).write(tmp_path)
    lines = file.read_text().split("\n")
    words = " ".join(lines[1:]).split()
    for length in range(len(words)):
        file.write_text(lines[0] + "\n" + " ".join(words[:length]))
        with pytest.raises(DataError, match=r"the file ends within|are missing"):
            Bundler(file)
    file.write_text(lines[0] + "\n" + " ".join([*words, "1.5"]))
    with pytest.raises(DataError, match="1 values too many"):
        Bundler(file)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "# Bundle file v0.3",
            "# Bundle file v0.1",
            "begins with '# Bundle file v0.1'; only files",
        ),
        ("3 12\n", "3 12.5\n", "12.5 is not a number of things"),
        ("255 0 17\n3 ", "255 0 17\nnan ", "point 0: nan is not a number of things"),
        ("255 0 17", "255 zero 17", "line 19: 'zero' is not a number"),
    ],
)
def test_malformed_files_say_where(tmp_path, old, new, message):
    file = Model().write(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError) as caught:
        Bundler(file)
    assert message in str(caught.value)
    assert str(file) in str(caught.value)


def test_a_list_of_other_photos_is_refused(tmp_path):
    (tmp_path / "list.txt").write_text("a.jpg\nb.jpg\n")
    with pytest.raises(DataError, match=r"list.txt: names 2 photos, bundle.out has 3"):
        Bundler(Model().write(tmp_path))


def test_files_that_are_not_there_are_named(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        Bundler(tmp_path / "bundle.out")
    with pytest.raises(DataError, match=r"there is no bundle.out"):
        Bundler(tmp_path)
    Model().write(tmp_path, "a.out")
    Model().write(tmp_path, "b.out")
    with pytest.raises(DataError, match=r"there are a.out, b.out"):
        Bundler(tmp_path)


# --- the real model


@needs_data
def test_real_model_reprojects():
    images = list(Bundler(Path(DATA) / "sfm/balbianello"))
    assert [image.id for image in images] == [f"BalbianelloMedium-{i}.jpg" for i in range(1, 6)]
    assert sum(len(image) for image in images) == 1417
    assert {(image.camera.width, image.camera.height) for image in images} == {(640, 427)}
    errors = np.concatenate([np.linalg.norm(image.residuals(), axis=1) for image in images])
    assert np.median(errors) < 0.135


@needs_data
def test_stretches_drawn_for_the_real_model_are_recovered():
    assert_drawn_stretches_are_recovered(Bundler(Path(DATA) / "sfm/balbianello"))


@needs_data
@pytest.mark.timing
def test_real_model_loads_quickly():
    loading = timed(lambda: list(Bundler(Path(DATA) / "sfm/balbianello")))
    assert reference_seconds(loading, below=0.03) < 0.03
