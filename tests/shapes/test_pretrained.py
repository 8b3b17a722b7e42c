"""Learned shapes that come with the package: files, names, and errors."""

import json
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cadalign
from cadalign import Alignment, Camera, ShapeModel, View
from cadalign.batch.observation_fit import ObservationFit
from cadalign.batch.runs import FitRunOptions
from cadalign.errors import InputError
from cadalign.io.observation import Observation
from cadalign.io.pretrained import CATEGORIES, shape_path
from cadalign.render import look_at

CAMERA = Camera(640, 480, fx=900.0, fy=900.0, cx=319.5, cy=239.5)
POSE = Alignment(np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 3.0], [1.0, 1.0, 1.0])
SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_keypoint_has_a_name_and_a_line(category):
    shape = ShapeModel.pretrained(category)
    assert len(set(shape.names)) == len(shape.names) == len(shape.ids)
    assert all(isinstance(label, int) for label in shape.ids)
    assert shape.training is None
    assert {row for line in shape.lines for row in line} == set(range(len(shape.ids)))


@pytest.mark.parametrize("category", CATEGORIES)
def test_names_say_where_keypoints_are(category):
    """Left is -x, the front is -z, up is +y: opposite names have opposite mean positions."""
    shape = ShapeModel.pretrained(category)
    place = dict(zip(shape.names, shape.mean, strict=False))
    for name, xyz in place.items():
        for word, other, axis in (("left", "right", 0), ("front", "back", 2)):
            if (opposite := name.replace(word, other)) != name and opposite in place:
                assert xyz[axis] < place[opposite][axis], name


def test_files_are_small():
    files = [shape_path(Path(name)) for name in CATEGORIES]
    assert sum(file.stat().st_size for file in files) < 1.5e6
    assert "Yang You" in (files[0].parent / "LICENSE.md").read_text()


def test_opens_in_ten_milliseconds():
    times = []
    for _ in range(5):
        start = time.perf_counter()
        ShapeModel.pretrained("vessel")
        times.append(time.perf_counter() - start)
    assert min(times) < 0.01


def test_names_and_ids_give_the_same_alignment():
    shape = ShapeModel.pretrained("chair")
    rows = shape.rows([0, 1, 2, 3, 4, 5, 17, 20])
    pixels = CAMERA.project(POSE.apply(shape.mean[rows]))
    by_id, by_name = (
        cadalign.align(shape, View(CAMERA, pixels, ids=[labels[row] for row in rows]))
        for labels in (shape.ids, shape.names)
    )
    np.testing.assert_array_equal(by_id.points_3d, by_name.points_3d)
    assert by_name.to_dict()["views"] == by_id.to_dict()["views"]


def test_unknown_category_lists_what_there_is():
    with pytest.raises(InputError, match=r"unknown category 'sofa'; known are airplane, .*vessel"):
        ShapeModel.pretrained("sofa")
    with pytest.raises(InputError, match=r"did you mean 'chair'"):
        ShapeModel.open("chiar")


def test_keypoint_of_another_category_is_refused():
    with pytest.raises(InputError, match=r"chair has no keypoint 'rim, front left'"):
        ShapeModel.pretrained("chair").rows(["rim, front left"])


def test_a_file_of_the_name_is_preferred(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    own = replace(ShapeModel.pretrained("mug"), category="own")
    own.save("mug")
    assert ShapeModel.open("mug").category == "own"
    assert "this file is used" in caplog.text
    assert ShapeModel.pretrained("mug").category == "mug"


def test_only_a_bare_name_is_a_category(tmp_path):
    with pytest.raises(InputError, match="unknown shape"):
        ShapeModel.open(tmp_path / "chair")


def test_observations_name_a_category_or_a_file_beside_them(tmp_path):
    seen = Observation(np.zeros((1, 3)), np.zeros((1, 2)), CAMERA, shape=shape_path("chair"))
    path = tmp_path / "photo.json"
    seen.save(path)
    assert json.loads(path.read_text())["shape"] == "chair"
    assert Observation.load(path).shape == shape_path("chair")
    (tmp_path / "chair").write_bytes(b"")
    assert Observation.load(path).shape == tmp_path / "chair"


def test_runs_depend_on_the_content_of_a_category():
    options = FitRunOptions(estimate=ObservationFit(shape=Path("chair")))
    assert shape_path("chair") in options.files
    assert options.as_config()["estimate"]["shape"] == "chair"


def test_saving_keeps_every_number(tmp_path):
    shape = ShapeModel.pretrained("laptop")
    finer = replace(shape.components[0], mean=shape.components[0].mean + 1e-12)
    for each in (shape, replace(shape, components=(finer, *shape.components[1:]))):
        each.save(tmp_path / "a.shape")
        opened = ShapeModel.open(tmp_path / "a.shape")
        np.testing.assert_array_equal(opened.components[0].mean, each.components[0].mean)
        assert opened.names == each.names
        assert opened.lines == each.lines


def exchange(name):
    return name.replace("right", "#").replace("left", "right").replace("#", "left")


PAIR = "keypoints '{0} left' and '{0} right' are exchanged"


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ("", "the photo is flipped or left and right are exchanged"),
        ("seat, front", PAIR.format("seat, front")),
        ("back, top", PAIR.format("back, top")),
    ],
)
def test_left_and_right_that_are_exchanged_are_named(wrong, text):
    shape = ShapeModel.pretrained("chair")
    rows = shape.rows([0, 1, 2, 3, 4, 5, 17, 18, 19, 20])
    pose = look_at(azimuth=30.0, elevation=20.0, distance=2.5)
    pixels = CAMERA.project(pose.apply(shape.mean[rows]))
    names = [shape.names[row] for row in rows]
    assert not cadalign.align(shape, View(CAMERA, pixels, ids=names, sigma=2.0)).warnings
    clicked = [exchange(each) if wrong in each else each for each in names]
    (found,) = cadalign.align(shape, View(CAMERA, pixels, ids=clicked, sigma=2.0)).warnings
    assert text in found.text


def test_warnings_call_keypoints_by_their_names():
    shape = ShapeModel.pretrained("chair")
    rows = shape.rows([0, 1, 2, 3, 4, 5, 17, 20])
    pixels = CAMERA.project(POSE.apply(shape.mean[rows]))
    pixels[0] += 90
    (found,) = cadalign.align(shape, View(CAMERA, pixels, ids=shape.ids[:6] + (17, 20))).warnings
    assert "keypoint 'back, top right' (" in found.text


def test_the_script_learns_the_files(real_data, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    sys.modules.pop("learn_shapes", None)
    import learn_shapes

    from cadalign.datasets import KeypointNet
    from cadalign.shapes.examples import examples_of

    dataset = KeypointNet(real_data / "keypointnet15").subset(categories=["cap"])
    table = tomllib.loads((SCRIPTS / "keypoint_names.toml").read_text())["cap"]
    learned = learn_shapes.learn(examples_of(dataset["cap"], meshes=False), "cap", table)
    learned.save(tmp_path / "cap.shape")
    shipped = ShapeModel.pretrained("cap")
    np.testing.assert_allclose(learned.mean, shipped.mean, atol=1e-6)
    assert learned.names == shipped.names
