"""Models that are not the object: learned shapes, and unknown focal lengths."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.geometry.camera import projection_jacobian
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.metrics import rotation_error
from cadalign.render import look_at

_SECOND_VIEW = rotation_from_vector(np.array([0.0, np.radians(25.0), 0.0]))
_NEAR = cadalign.Camera(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
"""An object that fills its image is near, at some 1.3 of its diagonals."""
_UNKNOWN = cadalign.Camera.without_focal(_NEAR.width, _NEAR.height)
_POINTS = 14
_MODE_LENGTH, _RESIDUAL = 0.06, 0.005
_ERRORS = ("R", "t", "f", "shape")


# Times --------------------------------------------------------------------------------------------


def align(
    given: BenchmarkData,
    *,
    categories: tuple[str, ...] = ("chair", "airplane", "mug"),
    objects: int = 40,
    keypoints: int = 14,
    noise_px: float = 2.0,
    repeats: int = 5,
    workers: int = 2,
) -> Tables:
    """Time of `align` with learned shapes: one view, two views, and a batch.

    Objects are those of the split val, seen with noisy keypoints; shape models are learned from the
    split train. Times of single objects are those of the processor, warm and on one thread.

    Parameters
    ----------
    categories : tuple[str, ...]
        Categories.
    objects : int
        Objects of each category.
    keypoints : int
        Most keypoints of an object.
    noise_px : float
        Standard deviation of the keypoints, in pixels.
    repeats : int
        Times that the batch holds every object.
    workers : int
        Threads of the batch.
    """
    dataset, rows = KeypointNet(given.needed()), []
    how = {"keypoints": keypoints, "noise_px": noise_px}
    for category in categories:
        shape = section.learned_shape(dataset, category)
        found = section.unseen_objects(dataset, category, objects, **how)
        pairs = [_two_views(shape, place, seen, noise_px) for place, seen in found]
        singles = [views[:1] for views in pairs]
        for views in singles[:2] + pairs[:2]:  # compile
            cadalign.align(shape, views)
        one, two = (
            [
                1e3 * section.processor_seconds(partial(cadalign.align, shape, views))
                for views in some
            ]
            for some in (singles, pairs)
        )
        batch = singles * repeats
        call = partial(cadalign.align_batch, shape, batch, workers=workers)
        rows.append(
            {
                "category": category,
                "components": len(shape.components),
                "one view ms": section.spread(one),
                "two views ms": float(np.median(two)),
                "batch 1/s": len(batch) / section.seconds(call),
            }
        )
    yield "align with a learned shape", rows


def _two_views(
    shape: cadalign.ShapeModel, place: int, seen: UnseenObject, noise_px: float
) -> list[cadalign.View]:
    known = np.isin(seen.ids, shape.ids)
    turned = replace(seen.gt, rotation=_SECOND_VIEW @ seen.gt.rotation)
    points, rng = seen.xyz[seen.rows][known], np.random.default_rng(place)
    second = section.seen_in(KEYPOINT_CAMERA, turned, points, noise_px, rng).points_2d
    return [
        cadalign.View(KEYPOINT_CAMERA, each, ids=seen.ids[known], sigma=noise_px)
        for each in (seen.points_2d[known], second)
    ]


# Unknown focal length -----------------------------------------------------------------------------


def focal_shapes(
    given: BenchmarkData,
    *,
    categories: tuple[str, ...] = ("airplane", "bathtub", "bottle", "chair", "mug"),
    objects: int = 60,
    noise_px: float = 2.0,
) -> Tables:
    """Unknown focal lengths beside learned shapes: the Cramer-Rao limit, and unseen objects.

    The first table's objects are drawn from a shape model, the second's are those of KeypointNet's
    split val, with models learned from its split train, in near views.

    Parameters
    ----------
    categories : tuple[str, ...]
        Categories of the unseen objects.
    objects : int
        Objects per category, and drawn objects per number of modes five times as many.
    noise_px : float
        Standard deviation of the unseen objects' keypoints, in pixels.
    """
    title = f"{_POINTS} keypoints, 1 px: median errors over the limit's of 7 + K unknowns"
    rng = np.random.default_rng
    yield title, [_drawn(rng(given.seed), k, 5 * objects) for k in (1, 3, 5)]
    if given.keypointnet is None:
        return
    dataset, rows, deviations = KeypointNet(given.keypointnet), [], []
    for category in categories:
        shape = section.learned_shape(dataset, category)
        row, found = _unseen(dataset, shape, given.seed, objects, noise_px)
        rows.append(row)
        deviations += found
    rows.append(dict.fromkeys(rows[0]) | {"category": "all", "f in 95 %": _held(deviations)})
    yield f"unseen objects in near views, {noise_px:g} px", rows


def _unseen(
    dataset: KeypointNet, shape: cadalign.ShapeModel, seed: int, objects: int, noise_px: float
) -> tuple[Row, list[float]]:
    """Errors with the focal length known and unknown; the latter's in sigmas."""
    held_out = dataset.subset(categories=[shape.category], split="val")
    rows, deviations = [], []
    for key in sorted(held_out.ids(shape.category))[:objects]:
        keypoints, rng = held_out[key].keypoints, instance_rng(seed, *key)
        seen, ids = _see_near(keypoints.xyz, noise_px, rng), keypoints.ids.tolist()
        known, found = (_near(shape, ids, seen, noise_px, focal) for focal in ("known", "estimate"))
        if known is not None and found is not None and found.std is not None:
            rows.append([*_unseen_errors(known, ids, seen), *_unseen_errors(found, ids, seen)])
            deviations.append(float(np.log(found.camera.fx / _NEAR.fx) / found.std.focal))
    known_deg, known_iou, deg, iou = np.median(rows, axis=0).tolist()
    return {
        "category": shape.category,
        "objects": len(rows),
        "R known": known_deg,
        "R unknown deg": deg,
        "ratio of R": deg / known_deg,
        "extents' IoU known": known_iou,
        "unknown": iou,
        "f in 95 %": _held(deviations),
    }, deviations


def _see_near(points_3d: FloatArray, noise_px: float, rng: np.random.Generator) -> SimulatedProblem:
    gt, _ = sample_hull_view(KeypointHull(points_3d), _NEAR, rng=rng, min_visible=0)
    return section.seen_in(_NEAR, gt, points_3d, noise_px, rng)


def _near(
    shape: cadalign.ShapeModel,
    ids: Sequence[int],
    seen: SimulatedProblem,
    noise_px: float,
    focal: str,
) -> cadalign.Result | None:
    camera = seen.camera if focal == "known" else _UNKNOWN
    view = cadalign.View(camera, seen.points_2d, ids=ids, sigma=noise_px)
    return section.attempt(cadalign.align, shape, view, focal=focal)


def _drawn(rng: np.random.Generator, modes: int, objects: int) -> Row:
    """Median errors on objects of the model, over those of draws from the Cramer-Rao bound."""
    errors, limits = [], []
    for _ in range(objects):
        mean = rng.uniform(-0.35, 0.35, (_POINTS, 3))
        basis = rng.normal(0, _MODE_LENGTH, (modes, _POINTS, 3))
        shape = cadalign.ShapeModel.from_basis(
            mean, basis, np.ones(modes), residual_sigma=_RESIDUAL
        )
        weights = rng.normal(size=modes)
        points = mean + np.tensordot(weights, basis, 1)
        points += rng.normal(0, _RESIDUAL, points.shape)
        seen = _see_near(points, 1.0, rng)
        bound = _posterior_bound(seen, basis, noise_px=1.0)
        limits.append(
            _sizes(rng.multivariate_normal(np.zeros(len(bound)), bound, section.LIMIT_DRAWS))
        )
        result = _near(shape, range(_POINTS), seen, 1.0, "estimate")
        if result is None:
            errors.append(np.full((1, len(_ERRORS)), np.inf))
            continue
        moved = section.deviation(est=result.alignment, gt=seen.alignment)[:6]
        flat = basis.reshape(modes, -1).T
        shares = np.linalg.lstsq(flat, (result.points_3d - mean).ravel(), rcond=None)[0]
        error = [*moved, np.log(result.camera.fx / _NEAR.fx), *(shares - weights)]
        errors.append(_sizes(np.array([error])))
    ratios = np.median(np.concatenate(errors), axis=0) / np.median(np.concatenate(limits), axis=0)
    return {"modes K": modes, **dict(zip(_ERRORS, ratios.tolist(), strict=True))}


def _sizes(errors: FloatArray) -> FloatArray:
    """Sizes (n, 4) of errors (n, 7 + K) in the order of `_ERRORS`."""
    parts = np.split(errors, [3, 6, 7], axis=1)
    return np.stack([np.linalg.norm(part, axis=1) for part in parts], axis=1)


def _posterior_bound(seen: SimulatedProblem, basis: FloatArray, *, noise_px: float) -> FloatArray:
    """Least covariance (7 + K, 7 + K) of rotation, translation, log focal length and modes.

    Inverse of the keypoints' Fisher information at the truth and that of the modes' prior; what
    the modes leave is noise of the keypoints.
    """
    jacobian = projection_jacobian(seen.points_3d, _NEAR, seen.alignment)
    by_place = jacobian[:, :, 3:6] @ seen.alignment.rotation
    by_mode = np.einsum("nia,kna->nik", by_place, basis)
    rows = np.concatenate([jacobian[:, :, :6], jacobian[:, :, 9:], by_mode], axis=2)
    noise = noise_px**2 * np.eye(2) + _RESIDUAL**2 * by_place @ by_place.transpose(0, 2, 1)
    information = np.einsum("nik,nil->kl", rows, np.linalg.solve(noise, rows))
    information[7:, 7:] += np.eye(len(basis))
    return np.linalg.inv(information)


def _unseen_errors(
    result: cadalign.Result, ids: Sequence[int], seen: SimulatedProblem
) -> tuple[float, float]:
    """Rotation error [deg], and intersection over union of the extents up to scale."""
    _, rows, kept = np.intersect1d(result.ids, ids, return_indices=True)
    extents = np.ptp(result.points_3d[rows], axis=0), np.ptp(seen.points_3d[kept], axis=0)
    a, b = (each / np.linalg.norm(each) for each in extents)
    overlap = np.prod(np.minimum(a, b)) / np.prod(np.maximum(a, b))
    return rotation_error(est=result.alignment, gt=seen.alignment), float(overlap)


def _held(deviations: Sequence[float]) -> float:
    """Share of focal lengths within their 95 % interval [%]."""
    return section.percent(np.abs(deviations) < section.WITHIN_95)


# Lenses of photos ---------------------------------------------------------------------------------

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
        yield section.seen_in(camera, pose, points, noise_px, rng), ids.tolist()


def _row(
    model: Any, seen: Sequence[tuple[SimulatedProblem, list[int]]], prior: str, noise_px: float
) -> Row:
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
