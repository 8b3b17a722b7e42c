"""Real cars of KITTI with keypoints from a network.

Geiger et al., "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012.
The keypoints and the linear shape are those of Krishna et al., "Reconstructing Vehicles from a
Single Image: Shape Priors for Road Scene Understanding", ICRA 2017.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.images import photo_size
from cadalign.metrics import box_iou
from cadalign.shapes.basis import find_mirror, mirror_rows

_LEAST_KEYPOINTS, _SURE = 6, 0.4  # score of a keypoint
_CELLS = 64  # cells of the network's heatmap along the longer side of a car's rectangle
_SIZE = (1242, 375)  # [px], of missing photos
_MEAN_CAR = np.array([1.63, 3.88, 1.53])  # width, length and height of cars in KITTI [m]
_MODELS: dict[str, dict[str, Any]] = {  # options of the mean car's model
    "rigid": {"stretch": "none"},
    "stretched": {},
    "similar": {"shape_sigma": 0.04 * float(np.linalg.norm(_MEAN_CAR))},
}
_LENGTH_SIGMAS = (0.05, 0.11, 0.08)  # of the logs of width, length and height
_MODE_DEVIATION = 1.5  # of modes with unit norm; the mean car is about 8 units long
_REST = 0.03  # [m], residual of keypoints beside the modes
# The frame of models and boxes (x to the car's left, y to its rear, z up) from KITTI's object frame
# (x forward, y down, z left at rotation_y = 0).
_OBJECT_FROM_CAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def cars(given: BenchmarkData) -> Tables:
    """Cars of KITTI with at least 6 keypoints of a score above 0.4, with KITTI's metrics.

    Medians and 90th percentiles. A tilted estimate is replaced by the upright box with its heading,
    centre and extents.
    """
    folder = given.folder("real", "kitti_cars")
    shape = _car_shape(folder)
    seen = [({}, car) for car in _read_cars(folder) if len(car.names) >= _LEAST_KEYPOINTS]
    methods = {
        each: partial(_errors, method=each, shape=shape) for each in ("epnp", *_MODELS, "shape")
    }
    yield "Cars of KITTI", section.summaries(section.measure(seen, methods), "method")


class _Car(NamedTuple):
    """A car in a photo: its keypoints with high scores, and its true box."""

    camera: cadalign.Camera
    box: cadalign.Box
    mean: dict[str, list[float]]  # positions of all keypoints on the mean car by name [m]
    names: tuple[str, ...]  # (k,)
    points_2d: FloatArray  # (k, 2), [px]
    side: float  # longer side of its rectangle [px]
    bounds: FloatArray  # (2, 3), the mean car's box [m]


def _read_cars(folder: Path) -> Iterator[_Car]:
    """All cars of all frames."""
    for each in json.loads((folder / "cars.json").read_text()):
        keypoints = {key: [mark[key] for mark in each["keypoints"]] for key in each["keypoints"][0]}
        image = folder / each["image"]
        size = photo_size(image) if image.is_file() else _SIZE
        yield _car(each | keypoints | {"names": keypoints["name"]}, size)
    tracks = json.loads((folder / "car_tracks.json").read_text())
    for track in tracks.pop("tracks"):
        for frame in track["frames"]:
            yield _car({**track, **frame, **tracks, "xyz": tracks["model_xyz"]}, _SIZE)


def _car(entry: dict[str, Any], size: tuple[int, int]) -> _Car:
    (fx, _, cx), (_, fy, cy), _ = entry["K"]
    left, top, right, bottom = entry["bbox"]
    height, width, length = entry["dims_hwl"]
    sure = np.array(entry["score"]) > _SURE
    return _Car(
        cadalign.Camera(*size, fx, fy, cx, cy),
        _car_box([width, length, height], entry["location_bottom_centre"], entry["rotation_y"]),
        dict(zip(entry["names"], entry["xyz"], strict=True)),
        tuple(np.array(entry["names"])[sure].tolist()),
        np.array(entry["uv"], dtype=float)[sure],
        max(right - left, bottom - top),
        _car_bounds(np.array(entry["xyz"])),
    )


def _car_box(extents: Any, bottom: Any, yaw: float) -> cadalign.Box:
    """The upright box of a width, length and height, the centre of its bottom, and a yaw."""
    turn = rotation_from_vector(np.array([0.0, yaw, 0.0]))
    center = np.array(bottom) - [0, extents[2] / 2, 0]
    return cadalign.Box(center, turn @ _OBJECT_FROM_CAR, np.array(extents))


def _car_bounds(points: FloatArray) -> FloatArray:
    """The box (2, 3) of the mean car; its top is at the highest keypoint."""
    low, high = points.min(axis=0), points.max(axis=0)
    center = np.array([*(low[:2] + high[:2]) / 2, high[2] - _MEAN_CAR[2] / 2])
    return np.array([center - _MEAN_CAR / 2, center + _MEAN_CAR / 2])


def _car_shape(folder: Path) -> cadalign.ShapeModel:
    """The linear shape of cars, in metres."""
    tracks = json.loads((folder / "car_tracks.json").read_text())
    points, names = np.array(tracks["model_xyz"]), tracks["names"]
    mean = np.loadtxt(folder / "meanShape_2.txt")
    metres, *_ = np.linalg.lstsq(mean - mean.mean(axis=0), points - points.mean(axis=0), rcond=None)
    modes = np.loadtxt(folder / "vectors2.txt").reshape(-1, *points.shape) @ metres
    modes = np.concatenate([modes, [points * axis for axis in np.eye(3)]])
    deviations = [*[_MODE_DEVIATION] * (len(modes) - 3), *_LENGTH_SIGMAS]
    # The mean of annotated cars is slightly asymmetric, so it is averaged with its mirror image.
    rows = np.vstack([points, _car_bounds(points)])
    mirror = find_mirror(rows[None], axis=0)
    moved = mirror_rows(rows + np.pad(modes, ((0, 0), (0, 2), (0, 0))), mirror)
    image = mirror_rows(rows[None], mirror)[0]
    mean, images = (rows + image) / 2, (moved - image)[:, :-2]
    return cadalign.ShapeModel.from_basis(
        mean[:-2],
        np.concatenate([modes, images]) / np.sqrt(2),
        [*deviations, *deviations],
        ids=names,
        box=mean[-2:],
        residual_sigma=_REST,
        category="Car",
        up_axis="z",
        unit="m",
    )


def _errors(car: _Car, *, method: str, shape: cadalign.ShapeModel) -> Row:
    """Errors of yaw and depth, and IoU of the upright boxes."""
    est, gt = _box_of(car, method, shape), car.box
    turn = _yaw(est.rotation) - _yaw(gt.rotation)
    return {
        "yaw, deg": float(np.degrees(abs((turn + np.pi) % (2 * np.pi) - np.pi))),
        "depth, %": 100 * float(abs(est.center[2] / gt.center[2] - 1)),
        "3D IoU": box_iou(est=_upright(est), gt=_upright(gt)),
    }


def _box_of(car: _Car, method: str, shape: cadalign.ShapeModel) -> cadalign.Box:
    """The estimated box of a car."""
    if method == "epnp":
        points = np.array([car.mean[name] for name in car.names])
        found = cadalign.fit(points, car.points_2d, car.camera, method="epnp")
        return cadalign.Box.from_model(car.bounds, found.alignment)
    model: Any = shape
    if method in _MODELS:
        points, how = np.array(list(car.mean.values())), {"up_axis": "z", **_MODELS[method]}
        model = cadalign.Model(points_3d=points, ids=list(car.mean), bounds=car.bounds, **how)
    sigma = max(car.side / _CELLS, 0.5)
    view = cadalign.View(car.camera, car.points_2d, ids=car.names, sigma=sigma)
    result = cadalign.align(model, view)
    return cadalign.Box.from_model(result.bounds, result.alignment)


def _yaw(rotation: FloatArray) -> float:
    """KITTI's rotation_y [rad] of a rotation from car to camera."""
    forward = -rotation[:, 1]
    return float(np.arctan2(-forward[2], forward[0]))


def _upright(box: cadalign.Box) -> cadalign.Box:
    bottom = box.center + [0, box.extents[2] / 2, 0]
    return _car_box(box.extents, bottom, _yaw(box.rotation))
