"""Models that are not the object: times with learned shapes, and lenses of photos."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Table, Tables
from cadalign.arrays import instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.metrics import rotation_error
from cadalign.render import look_at

_CATEGORIES = ("chair", "airplane", "mug")
_NOISE_PX = 2.0
_UNKNOWN = cadalign.Camera.without_focal(640, 480)
_SHORTEST_MM, _MEDIAN_MM, _SHAPE, _LONGEST_MM, _FILM_MM = 14.0, 17.0, 0.8, 200.0, 36.0
_LEAST_KEYPOINTS = 6
_WITHIN_95 = 1.96


def shapes(given: BenchmarkData) -> Tables:
    """Times with learned shapes, and unknown lenses."""
    yield _times(given)
    yield from _photo_lenses(given)


def _times(given: BenchmarkData) -> Table:
    """Time of `align` of a view with a learned shape, and of a batch.

    Objects are those of the split val, seen with up to 14 noisy keypoints; shape models are learned
    from the split train. Times of single objects are those of the processor, warm and on one
    thread; the batch holds every object five times and has two threads.
    """
    dataset, rows = KeypointNet(given.folder("keypointnet")), []
    for category in _CATEGORIES:
        shape = section.learned_shape(dataset, category)
        how = {"keypoints": 14, "noise_px": _NOISE_PX}
        found = section.unseen_objects(dataset, category, given.count or 40, **how)
        views = [_view(shape, seen) for _, seen in found]
        for view in views[:2]:  # compile
            cadalign.align(shape, view)
        calls = (partial(cadalign.align, shape, view) for view in views)
        one = [1e3 * section.processor_seconds(call) for call in calls]
        batch = [[view] for view in views] * 5
        call = partial(cadalign.align_batch, shape, batch, workers=2)
        row = {"category": category, "components": len(shape.components)}
        rate = len(batch) / section.seconds(call)
        rows.append(row | {"one view ms": section.spread(one), "batch 1/s": rate})
    return "align with a learned shape", rows


def _view(shape: cadalign.ShapeModel, seen: UnseenObject) -> cadalign.View:
    known = np.isin(seen.ids, shape.ids)
    pixels, ids = seen.points_2d[known], seen.ids[known]
    return cadalign.View(KEYPOINT_CAMERA, pixels, ids=ids, sigma=_NOISE_PX)


# Lenses of photos ---------------------------------------------------------------------------------


def _photo_lenses(given: BenchmarkData) -> Tables:
    """Unknown focal lengths of photos' lenses: what the prior of usual lenses and EXIF data bring.

    Objects of the split val fill their images, through lenses of the distribution of focal lengths
    of `FocalPrior.of_usual_lenses`. Models are the learned shape of the category, or its mean as a
    model that is only similar.
    """
    dataset = KeypointNet(given.folder("keypointnet"))
    for category in _CATEGORIES:
        shape = section.learned_shape(dataset, category)
        mean = shape.components[0].mean[: len(shape.ids)]
        similar = cadalign.Model(points_3d=mean, ids=shape.ids, shape_sigma=0.05)
        found = section.unseen_objects(dataset, category, given.count or 40, noise_px=_NOISE_PX)
        seen = list(_seen(found, shape, given.seed))
        for title, model in (("learned shape", shape), ("its mean as a similar model", similar)):
            rows = [_row(model, seen, prior) for prior in ("none", "usual", "EXIF", "known")]
            yield f"{category}, {title}", rows


def _seen(
    found: Iterable[tuple[int, UnseenObject]], shape: cadalign.ShapeModel, seed: int
) -> Iterator[tuple[SimulatedProblem, list[int]]]:
    """The objects through lenses of photos, and the ids of their keypoints."""
    width, height = _UNKNOWN.width, _UNKNOWN.height
    for place, one in found:
        known = np.isin(one.ids, shape.ids)
        points, ids = one.xyz[one.rows][known], one.ids[known]
        if len(ids) < _LEAST_KEYPOINTS:
            continue
        rng = instance_rng(seed, f"{shape.category}/{place}")
        length = _SHORTEST_MM + _MEDIAN_MM * float(np.exp(_SHAPE * rng.normal()))
        focal = width * min(length, _LONGEST_MM) / _FILM_MM
        camera = cadalign.Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        distance = 0.5 + focal / (0.6 * height)  # of the middle of an object of diagonal 1
        pose = look_at(azimuth=rng.uniform(0, 360), elevation=rng.uniform(5, 40), distance=distance)
        yield section.seen_in(camera, pose, points, _NOISE_PX, rng), ids.tolist()


def _row(model: Any, seen: Sequence[tuple[SimulatedProblem, list[int]]], prior: str) -> Row:
    errors, focals, holds = [], [], []
    for number, (one, ids) in enumerate(seen):
        rng = instance_rng(number, "exif")
        stated = cadalign.FocalPrior(one.camera.fx * float(np.exp(0.05 * rng.normal())), 0.05)
        options: dict[str, Any] = {
            "none": {"focal": "estimate", "focal_prior": None},
            "usual": {"focal": "estimate"},
            "EXIF": {"focal": "estimate", "focal_prior": stated},
            "known": {},
        }[prior]
        camera = one.camera if prior == "known" else _UNKNOWN
        view = cadalign.View(camera, one.points_2d, ids=ids, sigma=_NOISE_PX)
        result = section.attempt(cadalign.align, model, view, **options)
        if result is None:
            errors.append(180.0)
            continue
        errors.append(rotation_error(est=result.alignment, gt=one.alignment))
        focals.append(abs(np.log(result.camera.fx / one.camera.fx)))
        holds.append(focals[-1] <= _WITHIN_95 * result.std.focal)
    row: Row = {"prior": prior, "R deg": section.spread(errors)}
    if prior == "known":
        return row
    return row | {
        "focal off %": 100 * float(np.median(focals)),
        "off by 3 times %": 100 * int((np.exp(focals) > 3).sum()) / len(seen),
        "in 95 % interval": section.percent(holds),
    }
