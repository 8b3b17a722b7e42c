"""`cadalign evaluate tracks`: simulated videos, KITTI's cars, methods of one's own, refusals."""

from __future__ import annotations

import json
import signal
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.forked import Program
from support.refusals import refusal_line

import cadalign
from cadalign import Result, ShapeModel, View
from cadalign.evaluation.api import run
from cadalign.evaluation.experiments.tracks import METHODS, SPEC, TracksOptions
from cadalign.evaluation.instances.tracks import TrackEstimate, simulated_video, track_errors
from cadalign.evaluation.runs.folder import RunFolder

SYNSET = "03001627"
BASE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
TRAIN, OBJECTS = 30, 2


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Boxes of random proportions with two bars, in KeypointNet's layout."""
    path = tmp_path_factory.mktemp("boxes")
    (path / "annotations").mkdir()
    (path / "splits").mkdir()
    place = {"face_index": 0, "face_uv": [1.0, 0.0, 0.0]}
    objects = []
    for number in range(TRAIN + OBJECTS):
        rng = np.random.default_rng(number)
        extents = np.exp(0.2 * rng.standard_normal(3))
        bars = [[0.0, height, 0.5] for height in 0.1 * rng.standard_normal(2)]
        points = np.vstack([BASE, bars]) * extents / np.linalg.norm(extents)
        keypoints = [
            {"xyz": xyz.tolist(), "semantic_id": label, "mesh_info": place}
            for label, xyz in enumerate(points)
        ]
        objects.append({"class_id": SYNSET, "model_id": f"{number:03d}", "keypoints": keypoints})
    (path / "annotations" / "chair.json").write_text(json.dumps(objects))
    for name, numbers in (("train", range(TRAIN)), ("val", range(TRAIN, TRAIN + OBJECTS))):
        lines = [f"{SYNSET}-{number:03d}\n" for number in numbers]
        (path / "splits" / f"{name}.txt").write_text("".join(lines))
    return path


def smooth_alone(model: ShapeModel, views: Sequence[View]) -> Result:
    return cadalign.align(model, views, motion="smooth")


def first_view(model: ShapeModel, views: Sequence[View]) -> Result:
    return cadalign.align(model, views[0])


@pytest.mark.slow
def test_methods_are_compared_on_simulated_videos(root: Path, tmp_path: Path) -> None:
    methods: list[Any] = [*METHODS, smooth_alone, first_view]
    table = cadalign.evaluate(
        root, "tracks", frames=16, methods=methods, workers=0, out=tmp_path / "run"
    )
    rows = {name: table[table.method == name] for name in table.method.unique()}
    assert len(rows) == len(methods)
    assert {len(each) for each in rows.values()} == {OBJECTS}
    assert (rows["first_view"].reason.str.contains("does not return the result of all")).all()
    for column in ("rotation_error_deg", "jitter_deg", "depth_error_relative"):
        np.testing.assert_array_equal(rows["smooth"][column], rows["smooth_alone"][column])
    jitter = {name: each.jitter_deg.median() for name, each in rows.items()}
    assert jitter["smooth"] < jitter["shared"] / 3 < jitter["frames"] / 3
    assert jitter["smooth"] < jitter["online"]
    assert (rows["online"].found < 1).all()  # until the track begins
    assert rows["smooth"].rotation_error_deg.median() < 4
    SPEC.write(SPEC.open(tmp_path / "run"))
    assert "jitter_deg" in (tmp_path / "run" / "summary.csv").read_text()


@pytest.mark.slow
def test_mistakes_of_the_detector_are_found(root: Path) -> None:
    options = {"flipped": 0.1, "outliers": 0.1, "frames": 20, "max_models": 1}
    table = cadalign.evaluate(root, "tracks", methods=["smooth"], workers=0, **options)
    assert table.flips.tolist() == [0]
    assert table.rotation_error_deg.max() < 5


_KILLED = """
import os, signal, sys
from pathlib import Path
from cadalign.evaluation.api import run
from cadalign.evaluation.experiments.tracks import TracksOptions
from cadalign.evaluation.runs.folder import RunFolder

def kill(progress):
    if progress.done:
        os.kill(os.getpid(), signal.SIGKILL)

root, out = map(Path, sys.argv[1:])
options = TracksOptions(root, frames=12, methods=("smooth", "online"))
run(options, RunFolder(out), workers=0, dask=None, on_progress=kill)
"""


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bytes(root: Path, tmp_path: Path) -> None:
    options = TracksOptions(root, frames=12, methods=("smooth", "online"))
    whole, broken = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "broken")
    run(options, whole, workers=0, dask=None)
    assert Program(_KILLED, root, broken.path).wait() == -signal.SIGKILL
    assert broken.parts.is_dir()
    assert not broken.results.exists()
    run(options, broken, workers=0, dask=None)
    assert broken.results.read_bytes() == whole.results.read_bytes()
    assert broken.config_file.read_bytes() == whole.config_file.read_bytes()


def test_videos_follow_from_seed_and_name() -> None:
    made = partial(simulated_video, names=("chair", "a"), xyz=BASE, ids=np.arange(8))
    (views, truth), (again, same) = (made(TracksOptions(frames=5)) for _ in range(2))
    other, _ = made(TracksOptions(frames=5, seed=1))
    for one, two in zip(views, again, strict=True):
        np.testing.assert_array_equal(np.asarray(one.points_2d), np.asarray(two.points_2d))
    np.testing.assert_array_equal(truth, same)
    assert np.abs(np.asarray(views[0].points_2d) - np.asarray(other[0].points_2d)).max() > 1
    centre = truth[0, 9:] / truth[0, 11]
    camera = views[0].camera
    pixel = [camera.fx * centre[0] + camera.cx, camera.fy * centre[1] + camera.cy]
    assert camera.contains(np.array([pixel])).all()


def test_frames_without_a_pose_are_left_out() -> None:
    gt = np.array([[*np.eye(3).ravel(), 0.1 * k, 0.0, 4.0] for k in range(6)])
    est = gt.copy()
    est[:, 11] *= 1.1
    est[2] = np.nan
    covariances = np.tile(1e-4 * np.eye(3), (6, 1, 1))
    found = track_errors(TrackEstimate(est, covariances), gt)
    assert found["found"] == pytest.approx(5 / 6)
    assert found["rotation_error_deg"] == pytest.approx(0, abs=1e-5)
    assert found["depth_error_relative"] == pytest.approx(0.1)
    assert (found["flips"], found["rotation_in_95"]) == (0, 1)
    assert np.isnan(found["yaw_error_deg"])
    est[2], est[1::2], covariances[:] = gt[2] * np.append(np.ones(11), 1.1), np.nan, np.nan
    found = track_errors(TrackEstimate(est, covariances), gt)
    columns = ("relative_translation", "jitter_deg", "rotation_in_95")
    assert np.isnan([found[name] for name in columns]).all()
    assert found["absolute_translation"] == pytest.approx(0.4)


@pytest.mark.slow
def test_tracks_of_real_cars(real_data: Path) -> None:
    table = cadalign.evaluate(real_data / "real" / "kitti_cars", "tracks", noise_px=3.0, workers=0)
    assert set(table.status) == {"ok"}
    assert set(table.model_id) == {"0005/17", "0010/0"}
    rows = {name: table[table.method == name] for name in METHODS}
    assert (rows["smooth"].jitter_deg.to_numpy() < rows["frames"].jitter_deg.to_numpy() / 3).all()
    assert table.yaw_error_deg.median() < 3


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (["--visible", "0"], "--visible: 0 is not positive"),
        (["--correlation", "1.5"], "--correlation: 1.5 is not between 0 and 1"),
        (["--frames", "2"], "--frames: 2 is less than 3"),
        (["--rate", "0"], "--rate: 0 is not positive"),
        (["--split", "train"], "both are 'train'"),
    ],
)
def test_bad_options_are_refused(
    more: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert line in refusal_line(capsys, "evaluate", "tracks", *more)
