"""Real cars of KITTI with keypoints of a network: methods, and runs over the keypoints.

Geiger et al., "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012.
The keypoints and the linear shape are those of Krishna et al., "Reconstructing Vehicles from a
Single Image: Shape Priors for Road Scene Understanding", ICRA 2017.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray
from cadalign.geometry.metrics import box_iou
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.images import photo_size
from cadalign.shapes.basis import find_reflection

_LEAST_KEYPOINTS = 6
_SCORED, _SURE = 0.1, 0.4  # scores of keypoints
_CELLS = 64  # of a network's heatmap along the longer side of a car's rectangle
_SIGMA = 3.0  # [px] of the network's keypoints
_SHAPE_SIGMA = 0.04  # of the similar model's keypoints [diagonals]
_SIZE = (1242, 375)  # of a photo that is not there [px]
_MEAN_CAR = np.array([1.63, 3.88, 1.53])  # width, length and height of cars in KITTI [m]
_LENGTH_SIGMAS = (0.05, 0.11, 0.08)  # of their logs
_MODE_DEVIATION = 1.5  # of modes of unit norm, on a mean of about 8 units of length
_REST = 0.03  # what the modes leave of a keypoint's place [m]
# The frame of models and boxes (x to the car's left, y to its rear, z up) from KITTI's object frame
# (x forward, y down, z left at rotation_y = 0).
_OBJECT_FROM_CAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


class _Car(NamedTuple):
    """A car in a photo: keypoints of the mean car, and its true box."""

    camera: cadalign.Camera
    box: cadalign.Box
    names: tuple[str, ...]  # (k,)
    points_3d: FloatArray  # (k, 3), on the mean car [m]
    points_2d: FloatArray  # (k, 2), [px]
    scores: FloatArray  # (k,)
    side: float  # the longer one of its rectangle [px]

    @property
    def bounds(self) -> FloatArray:
        """The mean car's box."""
        return _car_bounds(self.points_3d)


def _read_cars(folder: Path) -> Iterator[_Car]:
    """Every car in every frame."""
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
    box = _car_box([width, length, height], entry["location_bottom_centre"], entry["rotation_y"])
    return _Car(
        cadalign.Camera(*size, fx, fy, cx, cy),
        box,
        tuple(entry["names"]),
        np.array(entry["xyz"]),
        np.array(entry["uv"], dtype=float),
        np.array(entry["score"]),
        max(right - left, bottom - top),
    )


def _car_box(extents: Any, bottom: Any, yaw: float) -> cadalign.Box:
    """The upright box of a width, length and height, the centre of its bottom, and a yaw."""
    turn = rotation_from_vector(np.array([0.0, yaw, 0.0]))
    center = np.array(bottom) - [0, extents[2] / 2, 0]
    return cadalign.Box(center, turn @ _OBJECT_FROM_CAR, np.array(extents))


def _car_bounds(points: FloatArray) -> FloatArray:
    """The box (2, 3) of the mean car: keypoints reach to the roof, and at wheels to their hubs."""
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
    box = _car_bounds(points)
    return cadalign.ShapeModel.from_basis(
        points,
        modes,
        np.full(len(modes), _MODE_DEVIATION),
        names=names,
        box=box,
        residual_sigma=_REST,
        size_sigma=_LENGTH_SIGMAS,
        # The mean of annotated cars is a little skew: its left wheel stands before its right one.
        reflection=find_reflection(np.vstack([points, box])[None], names, axis=0),
        category="Car",
        up_axis="z",
        unit="m",
    )


def _yaw(rotation: FloatArray) -> float:
    """KITTI's rotation_y [rad] of a rotation from a car's frame to the camera's."""
    forward = -rotation[:, 1]
    return float(np.arctan2(-forward[2], forward[0]))


def _yaw_error(est: FloatArray, gt: FloatArray) -> float:
    """Error of the yaw of rotations (3, 3), without a sign [deg]."""
    turn = _yaw(est) - _yaw(gt)
    return float(np.degrees(abs((turn + np.pi) % (2 * np.pi) - np.pi)))


# Methods ------------------------------------------------------------------------------------------


def real_cars(given: BenchmarkData) -> Tables:
    """Cars of KITTI with at least 6 keypoints that score more than 0.4, by KITTI's metrics.

    Medians; of yaw with the 90th percentile. A tilted estimate counts as the upright box of its
    heading, centre and extents.
    """
    folder = given.real("kitti_cars")
    shape = _car_shape(folder)
    cars = [each for each in _read_cars(folder) if (each.scores > _SURE).sum() >= _LEAST_KEYPOINTS]
    rows = []
    for method in ("epnp", "rigid", "stretched", "similar", "shape"):
        errors = [_box_errors(_box_of(car, method, shape), car.box) for car in cars]
        yaws, depths, ious, ious_above = np.array(errors).T
        row: Row = {"method": method, "yaw, deg": section.spread(yaws)}
        row |= {"depth, %": 100 * float(np.median(depths)), "3D IoU": float(np.median(ious))}
        rows.append(row | {"bird's-eye IoU": float(np.median(ious_above))})
    yield f"{len(cars)} cars", rows


def _box_of(car: _Car, method: str, shape: cadalign.ShapeModel) -> cadalign.Box:
    """The estimated box of a car."""
    sure = car.scores > _SURE
    points, pixels = car.points_3d[sure], car.points_2d[sure]
    if method == "epnp":
        found = cadalign.fit(points, pixels, car.camera, method="epnp")
        return cadalign.Box.from_model(car.bounds, found.alignment)
    diagonal = float(np.linalg.norm(_MEAN_CAR))
    kinds: dict[str, dict[str, Any]] = {
        "rigid": {"stretch": "none"},
        "stretched": {},
        "similar": {"shape_sigma": _SHAPE_SIGMA * diagonal},
    }
    model: Any = shape
    if method != "shape":
        known = {"points_3d": car.points_3d, "ids": car.names, "bounds": car.bounds}
        model = cadalign.Model(**known, up_axis="z", **kinds[method])
    names = tuple(np.array(car.names)[sure].tolist())
    view = cadalign.View(car.camera, pixels, ids=names, sigma=max(car.side / _CELLS, 0.5))
    result = cadalign.align(model, view)
    return cadalign.Box.from_model(result.bounds, result.alignment)


def _box_errors(est: cadalign.Box, gt: cadalign.Box) -> tuple[float, float, float, float]:
    """Errors of yaw [deg] and depth, relative; overlaps of the boxes and of their footprints."""
    upright, flat = zip(*((_upright(box), _footprint(box)) for box in (est, gt)), strict=True)
    return (
        _yaw_error(est.rotation, gt.rotation),
        float(abs(est.center[2] / gt.center[2] - 1)),
        box_iou(est=upright[0], gt=upright[1]),
        box_iou(est=flat[0], gt=flat[1]),
    )


def _upright(box: cadalign.Box) -> cadalign.Box:
    bottom = box.center + [0, box.extents[2] / 2, 0]
    return _car_box(box.extents, bottom, _yaw(box.rotation))


def _footprint(box: cadalign.Box) -> cadalign.Box:
    """The prism of height 1 on the footprint: volumes of prisms are areas of footprints."""
    return _car_box([*box.extents[:2], 1.0], box.center * [1, 0, 1], _yaw(box.rotation))


# Keypoints of a network ---------------------------------------------------------------------------


def real_detections(given: BenchmarkData) -> Tables:
    """Runs over real keypoints of networks: share aligned, errors of yaw and depth.

    Cars are all frames of KITTI with at least 6 keypoints that score 0.1, aligned with a mean car
    or with a learned shape; web photos are those of PASCAL3D+, whose poses and focal lengths are
    not known. Errors are medians, of yaw with the 90th percentile in parentheses.
    """
    folder = given.real("kitti_cars")
    cars = []
    for each in _read_cars(folder):
        kept = each.scores >= _SCORED
        if kept.sum() >= _LEAST_KEYPOINTS:
            names = tuple(np.array(each.names)[kept].tolist())
            pairs = each.points_3d[kept], each.points_2d[kept]
            cars.append((each, cadalign.Observation(*pairs, each.camera, names=names)))
    with tempfile.TemporaryDirectory() as temporary:
        learned: dict[str, Any] = {"shape": Path(temporary, "car.shape"), "sigma": _SIGMA}
        _car_shape(folder).save(learned["shape"])
        web = _write_web_photos(given.real("pascal3d") / "observations", Path(temporary, "web"))
        models = {"": {}, "--similar": {"similar": True}, "--shape --sigma 3": learned}
        outliers = {"": {}, "--robust": {"robust": True}, "--loss cauchy": {"loss": "cauchy"}}
        rows = []
        for model, way in product(models, outliers):
            name = f"{model} {way}".strip() or "plain"
            rows.append(_detections_row(name, cars, web, models[model] | outliers[way]))
    yield f"{len(cars)} cars, and web photos", rows


def _write_web_photos(source: Path, folder: Path) -> Path:
    """Write observations whose keypoints call their scores confidence as files of cadalign."""
    folder.mkdir()
    for path in sorted(source.glob("*.json")):
        seen = json.loads(path.read_text())
        for mark in seen["keypoints"]:
            mark["score"] = mark.pop("confidence")
        seen["image"] = str((source / seen["image"]).resolve())
        (folder / path.name).write_text(json.dumps(seen))
    return folder


def _detections_row(
    name: str, cars: list[tuple[_Car, cadalign.Observation]], web: Path, options: dict[str, Any]
) -> Row:
    found = cadalign.fit_many((seen for _, seen in cars), **options)
    errors = []
    for each, (car, _) in zip(found, cars, strict=True):
        if isinstance(each, cadalign.Result):
            center = (each.bounds if each.method == "align" else car.bounds).mean(axis=0)
            depth = each.alignment.apply([center])[0, 2]
            yaw = _yaw_error(each.alignment.rotation, car.box.rotation)
            errors.append((yaw, abs(depth / car.box.center[2] - 1)))
    yaws, depths = np.array(errors).T
    row = {"cadalign fit": name, "cars aligned": f"{len(yaws)} of {len(cars)}"}
    row |= {"yaw, deg": section.spread(yaws), "depth, %": 100 * float(np.median(depths))}
    if "shape" not in options:  # that of cars is not theirs
        photos = cadalign.fit_many(web, **options)
        row["web photos aligned"] = f"{int(photos.solved.sum())} of {len(photos)}"
    return row
