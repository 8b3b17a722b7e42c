"""Real cars of KITTI: runs over keypoints of networks."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray
from cadalign.datasets import open as open_data
from cadalign.datasets.photos.kitti_keypoints import (
    car_bounds,
    car_shape,
    yaw_of_car,
)

_LEAST_KEYPOINTS = 6
_SIGMA = 3.0  # [px] of the network's keypoints


def _yaw_error(est: FloatArray, gt: FloatArray) -> float:
    """Error of the yaw of rotations (3, 3), without a sign [deg]."""
    turn = yaw_of_car(est) - yaw_of_car(gt)
    return float(np.degrees(abs((turn + np.pi) % (2 * np.pi) - np.pi)))


def _middle(result: cadalign.Result) -> FloatArray:
    return result.bounds.mean(axis=0)


def _real_cars(folder: Path) -> Iterator[tuple[Any, cadalign.Camera, cadalign.Box, Any]]:
    """Keypoints of a network, camera, true box and mean car of every car."""
    for photo in open_data(folder):
        for car in photo.objects:
            box = None if car.truth is None else car.truth.box
            if car.keypoints is not None and box is not None and photo.camera is not None:
                yield car.keypoints, photo.camera, box, car.model


# Keypoints of a network ---------------------------------------------------------------------------


def real_detections(given: BenchmarkData) -> Tables:
    """Runs over real keypoints of networks: share aligned, errors of yaw and depth.

    Cars are all frames of KITTI with at least 6 keypoints that score 0.1, aligned with a mean car
    or with a learned shape; web photos are those of PASCAL3D+, whose poses and focal lengths are
    not known. Errors are medians, of yaw with the 90th percentile in parentheses.
    """
    folder, web = given.real("kitti_cars"), given.real("pascal3d") / "observations"
    cars = list(_observed_cars(folder))
    with tempfile.TemporaryDirectory() as temporary:
        learned: dict[str, Any] = {"shape": Path(temporary, "car.shape"), "sigma": _SIGMA}
        car_shape(folder).save(learned["shape"])
        models = {"": {}, "--similar": {"similar": True}, "--shape --sigma 3": learned}
        outliers = {"": {}, "--robust": {"robust": True}, "--loss cauchy": {"loss": "cauchy"}}
        rows = []
        for model, way in product(models, outliers):
            name = f"{model} {way}".strip() or "plain"
            rows.append(_detections_row(name, cars, web, models[model] | outliers[way]))
    yield f"{len(cars)} cars, and web photos", rows


_Car = tuple[cadalign.Observation, cadalign.Box, FloatArray]


def _observed_cars(folder: Path) -> Iterator[_Car]:
    """Observations of a mean car's keypoints, the car's true box, and the mean car's middle."""
    for seen, camera, box, model in _real_cars(folder):
        kept = np.flatnonzero(seen.visible)
        if len(kept) >= _LEAST_KEYPOINTS and model is not None:
            known = model.load_keypoints()
            names = tuple(seen.names[k] for k in kept)
            points = known.xyz[[known.names.index(name) for name in names]]
            observed = cadalign.Observation(points, seen.points_2d[kept], camera, names=names)
            yield observed, box, car_bounds(known.xyz).mean(axis=0)


def _detections_row(name: str, cars: list[_Car], web: Path, options: dict[str, Any]) -> Row:
    found = cadalign.fit_many((seen for seen, _, _ in cars), **options)
    errors = []
    for each, (_, box, middle) in zip(found, cars, strict=True):
        if isinstance(each, cadalign.Result):
            center = _middle(each) if each.method == "align" else middle
            depth = each.alignment.apply([center])[0, 2]
            yaw = _yaw_error(each.alignment.rotation, box.rotation)
            errors.append((yaw, abs(depth / box.center[2] - 1)))
    yaws, depths = np.array(errors).T
    row = {"cadalign fit": name, "cars aligned": f"{len(yaws)} of {len(cars)}"}
    row |= {"yaw, deg": section.spread(yaws), "depth, %": 100 * float(np.median(depths))}
    if "shape" not in options:  # that of cars is not theirs
        photos = cadalign.fit_many(web, **options)
        row["web photos aligned"] = f"{int(photos.solved.sum())} of {len(photos)}"
    return row
