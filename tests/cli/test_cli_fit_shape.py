"""`cadalign fit` with a learned shape or a similar model: results, pictures and refusals."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.files import TETRAHEDRON
from support.refusals import refusal_line

from cadalign import (
    Alignment,
    Camera,
    FocalPrior,
    Model,
    RansacOptions,
    Result,
    ShapeModel,
    View,
    align,
)
from cadalign.batch.observation_fit import views_of
from cadalign.cli import main
from cadalign.io.observation import Observation
from cadalign.render.layers import UNSEEN_COLOR
from cadalign.render.overlay import EST_COLOR
from cadalign.shapes.examples import Example

CAMERA = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
NAMES = tuple("abcdefgh")
FIT_ALONE = ("--similar", "--method aepnp")
STRETCH = ("--stretch y",)
FIX = "leave out one of the two"
RIGHT = np.array([1.1, 0.9, 1.2])  # lengths of the object's box
TRUTH = Alignment(np.diag([1.0, -1, -1]) @ np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]),
                  [0.1, -0.1, 6.0], np.ones(3))  # fmt: skip


def boxes(ids: Any) -> ShapeModel:
    """A shape model of boxes whose lengths vary by 10 %."""
    rng = np.random.default_rng(0)
    models = []
    for row in range(40):
        points = CORNERS * rng.normal(1, 0.1, 3) + rng.normal(0, 0.01, CORNERS.shape)
        bounds = np.stack([points.min(0), points.max(0)])
        models.append(Example(f"box {row}", ids, points, bounds))
    return ShapeModel.learn(models, category="box", up_axis="y")


@pytest.fixture(scope="module")
def numbered() -> ShapeModel:
    return boxes(range(8))


def write(folder: Path, count: int = 6, **fields: Any) -> Path:
    """Write an observation of a box's first corners, with noise; xyz is the unit box."""
    noise = np.random.default_rng(1).normal(0, 0.5, (8, 2))
    pixels = CAMERA.project(TRUTH.apply(CORNERS * RIGHT)) + noise
    fields = {"ids": np.arange(count), **fields}
    Observation(CORNERS[:count], pixels[:count], CAMERA, **fields).save(folder / "box.json")
    return folder / "box.json"


def edit(path: Path, **fields: Any) -> Path:
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, **fields}))
    return path


def has_color(path: Path, color: tuple[int, int, int]) -> bool:
    picture = cv2.imread(str(path))
    assert picture is not None
    near = np.abs(picture[..., ::-1].reshape(-1, 3).astype(int) - color).max(axis=1) < 40
    return int(near.sum()) > 20


# --- what it does ----------------------------------------------------------------------------


@pytest.mark.long
def test_learned_shape_gives_the_numbers_of_align(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], numbered: ShapeModel
) -> None:
    path = write(tmp_path)
    numbered.save(tmp_path / "box.shape")
    assert main(["fit", str(path), "--shape", str(tmp_path / "box.shape")]) == 0
    seen = Observation.load(path)
    expected = align(numbered, View(CAMERA, seen.points_2d, ids=range(6)))
    assert capsys.readouterr().out == f"{expected}\n"
    out = tmp_path / "box_fit"
    assert sorted(entry.name for entry in out.iterdir()) == ["fit.json", "overlay.png"]
    written = Result.from_dict(json.loads((out / "fit.json").read_text()))
    assert written.alignment == expected.alignment
    assert written.ids == tuple(range(8))
    lengths = written.stretch / RIGHT  # one image does not tell the size
    np.testing.assert_allclose(lengths / lengths[0], 1, rtol=0.1)
    for color in (EST_COLOR, UNSEEN_COLOR):
        assert has_color(out / "overlay.png", color)


@pytest.mark.long
def test_keypoints_are_found_by_name_and_need_no_xyz(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = boxes(NAMES)
    shape.save(tmp_path / "box.shape")
    path = write(tmp_path, names=NAMES[:6], ids=np.full(6, 3))
    keypoints = json.loads(path.read_text())["keypoints"]
    edit(path, keypoints=[{"name": each["name"], "uv": each["uv"]} for each in keypoints])
    assert main(["fit", str(path), "--shape", str(tmp_path / "box.shape"), "--sigma", "2"]) == 0
    uv = [each["uv"] for each in keypoints]
    expected = align(shape, View(CAMERA, uv, ids=NAMES[:6], sigma=2.0))
    assert capsys.readouterr().out == f"{expected}\n"


def test_names_of_the_shape_count_before_numbers_of_the_file(numbered: ShapeModel) -> None:
    names = {"ids": np.array([3, 0, 7]), "names": ("c", "a", "h")}
    seen = Observation(CORNERS[:3], CORNERS[:3, :2] + 9, CAMERA, **names)
    assert views_of(seen, replace(numbered, names=NAMES))[0].ids == (2, 0, 7)
    assert views_of(seen, numbered)[0].ids == (3, 0, 7)


def test_shape_of_the_file_is_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], numbered: ShapeModel
) -> None:
    numbered.save(tmp_path / "box.shape")
    path = write(tmp_path, shape=tmp_path / "box.shape")
    keypoints = json.loads(path.read_text())["keypoints"]
    bare = [{"semantic_id": each["semantic_id"], "uv": each["uv"]} for each in keypoints]
    edit(path, keypoints=bare)
    assert main(["fit", str(path)]) == 0
    expected = align(numbered, View(CAMERA, [each["uv"] for each in keypoints], ids=range(6)))
    assert capsys.readouterr().out == f"{expected}\n"
    line = refusal_line(capsys, "fit", path, "--shape-sigma", "0.1")
    assert line == f"{path}: keypoints[0].xyz: missing; give it, or name a category as --shape"
    assert refusal_line(capsys, "fit", path, "--similar") == (
        "--similar: has no effect together with a learned shape; leave out one of the two"
    )


def test_similar_model_is_that_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = {"stretch_sigma": 0.1, "sigma": 2.0}
    path = write(tmp_path, 8, fit_options=stored)
    assert main(["fit", str(path), "--shape-sigma", "0.05", "--stretch", "z"]) == 0
    seen = Observation.load(path)
    model = Model(points_3d=CORNERS, shape_sigma=0.05, stretch="z", stretch_sigma=0.1)
    expected = align(model, View(CAMERA, seen.points_2d, sigma=2.0))
    assert capsys.readouterr().out == f"{expected}\n"


def drop_focal(path: Path) -> Path:
    return edit(path, camera={"width": 640, "height": 480})


def test_prior_on_a_focal_length_is_that_of_the_file_and_flags_say_otherwise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], numbered: ShapeModel
) -> None:
    numbered.save(tmp_path / "box.shape")
    prior = FocalPrior(905.0, 0.01)
    stored = {"focal": "estimate", "focal_prior": asdict(prior), "loss": "huber"}
    path = write(tmp_path, 8, fit_options=stored, shape=tmp_path / "box.shape")
    view = View(CAMERA, Observation.load(path).points_2d)
    assert main(["fit", str(path)]) == 0
    printed = capsys.readouterr()
    found = align(numbered, view, loss="huber", focal="estimate", focal_prior=prior)
    assert printed.out == f"{found}\n"
    assert "The focal length is estimated with the prior 905 px +- 1 %" in printed.err
    assert main(["fit", str(path), "--focal", "known"]) == 0
    assert capsys.readouterr().out == f"{align(numbered, view, loss='huber')}\n"
    path = drop_focal(path)
    assert refusal_line(capsys, "fit", path, "--focal", "known") == (
        f"{path}: camera: the focal length is unknown; "
        "give --focal estimate, or a calibrated camera"
    )


def test_the_robust_search_and_confidences_count_with_a_shape(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], numbered: ShapeModel
) -> None:
    numbered.save(tmp_path / "box.shape")
    scores = np.array([0.9, 0.8, 0.1, 0.9, 0.8, 0.9, 0.7, 0.9])
    path = write(tmp_path, 8, shape=tmp_path / "box.shape", scores=scores)
    data = json.loads(path.read_text())
    data["keypoints"][2]["uv"] = [20.0, 400.0]
    path.write_text(json.dumps(data))
    assert main(["fit", str(path), "--robust"]) == 0
    view = View(CAMERA, Observation.load(path).points_2d, scores=scores)
    expected = align(numbered, view, ransac=RansacOptions())
    assert capsys.readouterr().out == f"{expected}\n"
    assert expected.inliers.tolist() == [k != 2 for k in range(8)]


@pytest.mark.long
def test_warped_mesh_is_drawn(tmp_path: Path, numbered: ShapeModel) -> None:
    (tmp_path / "model.obj").write_text(TETRAHEDRON)
    plain = write(tmp_path)
    numbered.save(tmp_path / "box.shape")
    drawn = []
    for _ in range(2):
        assert main(["fit", str(plain), "--shape", str(tmp_path / "box.shape")]) == 0
        drawn.append(cv2.imread(str(tmp_path / "box_fit" / "overlay.png")))
        edit(plain, model="model.obj")
    assert (drawn[0] != drawn[1]).any(axis=2).mean() > 0.01  # the box takes 0.07 of the image


def test_a_shape_that_was_replaced_is_not_exported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], numbered: ShapeModel
) -> None:
    numbered.save(tmp_path / "box.shape")
    path = write(tmp_path, shape=tmp_path / "box.shape")
    assert main(["fit", str(path), "--no-picture"]) == 0
    boxes(range(1, 9)).save(tmp_path / "box.shape")
    capsys.readouterr()
    line = refusal_line(capsys, "export", tmp_path / "box_fit", "--to", tmp_path / "box.glb")
    what = f"{tmp_path / 'box.shape'}: its 8 keypoints are not the fit's 8; fit the observation"
    assert what in line


# --- what it refuses -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (
            {"ids": np.array([0, 1, 9, 3, 12, 5])},
            "keypoints: box has no keypoint 9, 12; "
            "leave out what it lacks, or give one of [0, 1, 2, 3, 4, 5, 6, 7]",
        ),
        (
            {"ids": np.array([0, 1, 9, 3, 4, 5]), "names": NAMES[:6]},
            "keypoints: box has no keypoint 9; "
            "leave out what it lacks, or give one of [0, 1, 2, 3, 4, 5, 6, 7]",
        ),
        (
            {"ids": None, "names": NAMES[:6]},
            "keypoints: box has no keypoint 'a', 'b', 'c', 'd', 'e', 'f'; "
            "leave out what it lacks, or give one of [0, 1, 2, 3, 4, 5, 6, 7]",
        ),
        (
            {"ids": None},
            "keypoints: the keypoints have no semantic_id and no name",
        ),
        (
            {"ids": np.array([0, 1, 2, 3, 1, 5])},
            "keypoints[4].semantic_id: 1 occurs twice, first in keypoints[1]",
        ),
    ],
)
def test_keypoints_that_the_shape_cannot_take_are_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    numbered: ShapeModel,
    fields: dict[str, Any],
    text: str,
) -> None:
    numbered.save(tmp_path / "box.shape")
    path = write(tmp_path, **fields)
    line = refusal_line(capsys, "fit", path, "--shape", tmp_path / "box.shape")
    assert line == f"{path}: {text}"


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ("--shape-sigma=0", "--shape-sigma: 0.0 is not a positive number"),
        ("--shape none.shape", "none.shape: no such file"),
        (
            "--shape box.shape --shape-sigma 0.1",
            "--shape-sigma: has no effect together with a learned shape; "
            "give one of the two options",
        ),
        *(
            (f"{shape} {flag}", f"{flag.split()[0]}: has no effect together with {name}; {FIX}")
            for shape, name, flags in (
                ("--shape box.shape", "a learned shape", (*FIT_ALONE, *STRETCH)),
                ("--shape-sigma 0.1", "a similar shape", FIT_ALONE),
            )
            for flag in flags
        ),
    ],
)
def test_wrong_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: str, text: str
) -> None:
    assert refusal_line(capsys, "fit", write(tmp_path), *flags.split()) == text
