"""`align` on photos of real cars and chairs, whose shapes are not the models'."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cadalign import Alignment, Camera, Model, ShapeModel, View, align, fit
from cadalign.metrics import rotation_error
from cadalign.shapes.parts import Reflection

DATA = Path(os.environ.get("CADALIGN_DATA", "/nonexistent")) / "real"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="CADALIGN_DATA has no real photos")

CARS = DATA / "kitti_cars"
LENGTH_SIGMAS = (0.05, 0.11, 0.08)  # of the logs of width, length, height of 13 cars of KITTI
MODE_DEVIATION = 1.5  # of modes of unit norm, on a mean of about 8 units of length


def car_shape(tracks: dict[str, Any]) -> ShapeModel:
    """The 14-point car with its 5 modes, in metres, and the spread of real cars' dimensions."""
    mean = np.loadtxt(CARS / "meanShape_2.txt")
    points, names = np.array(tracks["model_xyz"]), tracks["names"]
    in_metres = np.linalg.lstsq(mean - mean.mean(0), points - points.mean(0), rcond=None)[0]
    modes = np.loadtxt(CARS / "vectors2.txt").reshape(5, 14, 3) @ in_metres
    return ShapeModel.from_basis(
        points,
        modes,
        np.full(5, MODE_DEVIATION),
        ids=names,
        residual_sigma=0.03,
        size_sigma=LENGTH_SIGMAS,
        reflection=Reflection("x", 0.0, tuple(zip(names[::2], names[1::2], strict=True))),
        up_axis="z",
        unit="m",
    )


def frames(tracks: dict[str, Any]) -> Any:
    """Camera, names, pixels, network pixel [px] and truth of every frame with 6 good keypoints."""
    for track in tracks["tracks"]:
        calibration = np.array(track["K"])
        fx, fy, cx, cy = calibration[[0, 1, 0, 1], [0, 1, 2, 2]]
        camera = Camera(1242, 375, fx, fy, cx, cy)
        for frame in track["frames"]:
            good = np.array(frame["score"]) > 0.4
            if good.sum() < 6:
                continue
            names = [name for name, kept in zip(tracks["names"], good, strict=True) if kept]
            left, top, right, bottom = frame["bbox"]
            cell = max(right - left, bottom - top) / 64
            yield camera, names, np.array(frame["uv"])[good], good, cell, frame


def errors(alignment: Alignment, center: np.ndarray, frame: dict[str, Any]) -> tuple[float, float]:
    """Errors of yaw [degrees] and of the centre's depth, relative."""
    front = -alignment.rotation[:, 1]
    turn = np.arctan2(-front[2], front[0]) - frame["rotation_y"]
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    depth = alignment.apply(center[None])[0, 2] / frame["location_bottom_centre"][2]
    return abs(float(np.degrees(turn))), abs(float(depth) - 1)


def test_cars_have_their_yaw_and_metric_depth() -> None:
    tracks = json.loads((CARS / "car_tracks.json").read_text())
    shape, points = car_shape(tracks), np.array(tracks["model_xyz"])
    ours, epnp = [], []
    for camera, names, pixels, good, cell, frame in frames(tracks):
        result = align(shape, View(camera, pixels, ids=names, sigma=cell))
        ours.append(errors(result.alignment, result.bounds.mean(axis=0), frame))
        rigid = fit(points[good], pixels, camera, method="epnp")
        middle = (points.min(0) + points.max(0)) / 2
        epnp.append(errors(rigid.alignment, middle, frame))
    yaw, depth = np.array(ours).T
    assert len(yaw) >= 20
    assert np.median(yaw) <= 2.2
    assert np.percentile(yaw, 90) <= 5
    assert np.median(depth) <= 0.065
    assert np.median(yaw) <= np.median([error for error, _ in epnp])


@pytest.mark.parametrize("name", ["bdc89254", "b4371c35"])
def test_chairs_that_are_only_similar_to_their_models(name: str) -> None:
    folder = DATA / "scan2cad"
    truth = json.loads((folder / "truth.json").read_text())[name]
    data = json.loads((folder / "observations" / f"{name}.json").read_text())
    gt = Alignment(
        np.array(truth["cam_from_model_rotation"]),
        truth["translation_in_model_x_units"],
        truth["stretch"],
    )
    points = [keypoint["xyz"] for keypoint in data["keypoints"]]
    pixels = [keypoint["uv"] for keypoint in data["keypoints"]]
    # Annotators click to about 8 px there, and chair and model differ by about 5 cm of 80.
    view = View(Camera.from_dict(data["camera"]), pixels, sigma=8.0)
    result = align(Model(points_3d=points, shape_sigma=0.05), view)
    assert rotation_error(est=result.alignment, gt=gt) <= 5
    assert (np.abs(result.stretch / gt.scale - 1) <= 0.2).all()
    logs = np.log(result.stretch / gt.scale) / np.array(result.std.scale)
    assert (np.abs(logs[1:]) < 2).all()
    assert rotation_error(est=result.alignment, gt=gt) < 2 * result.std.rotation_deg
