"""Cameras that are not known: lenses of photos."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.simulation import Problem
from cadalign.metrics import rotation_error
from cadalign.render import look_at

_UNKNOWN = cadalign.Camera.without_focal(640, 480)
_SHORTEST_MM, _MEDIAN_MM, _SHAPE, _LONGEST_MM, _FILM_MM = 14.0, 17.0, 0.8, 200.0, 36.0
_VIEWPOINT_DEG = 30.0
_LEAST_KEYPOINTS = 6
_PRIORS = ("none", "usual", "EXIF", "known")


def photo_lenses(
    given: BenchmarkData,
    *,
    categories: tuple[str, ...] = ("chair", "airplane", "mug"),
    objects: int = 40,
    noise_px: float = 2.0,
) -> Tables:
    """Unknown focal lengths of photos' lenses: what the prior of usual lenses and EXIF data bring.

    Objects of the split val fill their images, through lenses of the distribution of focal lengths
    of `FocalPrior.of_usual_lenses`. Models are the nearest one of the split train, only similar, or
    the learned shape of the category.

    Parameters
    ----------
    categories : tuple[str, ...]
        Categories.
    objects : int
        Objects of each category.
    noise_px : float
        Standard deviation of the keypoints, in pixels.
    """
    dataset = KeypointNet(given.needed())
    for category in categories:
        shape = section.learned_shape(dataset, category)
        mean = shape.components[0].mean[: len(shape.ids)]
        similar = cadalign.Model(points_3d=mean, ids=shape.ids, shape_sigma=0.05)
        found = section.unseen_objects(dataset, category, objects, noise_px=noise_px)
        seen = list(_seen(found, shape, given.seed, noise_px))
        for title, model in (("learned shape", shape), ("its mean as a similar model", similar)):
            rows = [_row(model, seen, prior, noise_px) for prior in _PRIORS]
            yield f"{category}, {title}", rows


def _seen(
    found: Iterable[tuple[int, UnseenObject]],
    shape: cadalign.ShapeModel,
    seed: int,
    noise_px: float,
) -> Iterator[tuple[Problem, list[int]]]:
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
        yield section.seen_in(camera, pose, points, noise_px, rng), ids.tolist()


def _row(model: Any, seen: Sequence[tuple[Problem, list[int]]], prior: str, noise_px: float) -> Row:
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
        view = cadalign.View(camera, one.points_2d, ids=ids, sigma=noise_px)
        result = section.attempt(cadalign.align, model, view, **options)
        if result is None:
            errors.append(180.0)
            continue
        errors.append(rotation_error(est=result.alignment, gt=one.alignment))
        focals.append(abs(np.log(result.camera.fx / one.camera.fx)))
        holds.append(focals[-1] <= section.WITHIN_95 * result.std.focal)
    is_known = prior == "known"
    return {
        "prior": prior,
        "R deg": section.spread(errors),
        "within 30 deg %": section.percent(np.array(errors) < _VIEWPOINT_DEG),
        "focal off %": 0.0 if is_known else 100 * float(np.median(focals)),
        "off by 3 times %": 100 * int((np.exp(focals) > 3).sum()) / len(seen),
        "in 95 % interval": 100.0 if is_known else section.percent(holds),
    }
