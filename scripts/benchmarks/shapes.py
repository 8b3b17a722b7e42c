"""Models that are not the object: learned shapes, unknown focal lengths, and similar models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.geometry.metrics import box_iou, rotation_error
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation
from cadalign.render import look_at
from cadalign.seeding import instance_rng
from cadalign.solvers.projection import projection_jacobian

_SECOND_VIEW = rotation_from_vector(np.array([0.0, np.radians(25.0), 0.0]))
_NEAR = cadalign.Camera(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
"""An object that fills its image is near, at some 1.3 of its diagonals."""
_UNKNOWN = cadalign.Camera.without_focal(_NEAR.width, _NEAR.height)
_POINTS = 14
_MODE_LENGTH, _RESIDUAL = 0.06, 0.005
_ERRORS = ("R", "t", "f", "shape")
_LEAST_KEYPOINTS = 6


class _Seen(NamedTuple):
    """Keypoints (n, 3) of an object, their noisy places (n, 2) [px], ids, camera, true pose."""

    points_3d: FloatArray
    points_2d: FloatArray
    ids: tuple[int, ...]
    camera: cadalign.Camera
    gt: cadalign.Alignment


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
    dataset = KeypointNet(given.needed())
    rows = [
        _times_of(
            dataset,
            category,
            objects,
            keypoints,
            noise_px,
            repeats,
            workers,
        )
        for category in categories
    ]
    yield "align with a learned shape", rows


def _times_of(
    dataset: KeypointNet,
    category: str,
    objects: int,
    keypoints: int,
    noise_px: float,
    repeats: int,
    workers: int,
) -> Row:
    shape = section.learned_shape(dataset, category)
    pairs = list(_pairs(dataset, category, shape, objects, keypoints, noise_px))
    singles = [views[:1] for views in pairs]
    for views in singles[:2] + pairs[:2]:  # compile
        cadalign.align(shape, views)
    one, two = (
        [
            1e3 * section.processor_seconds(lambda v=views: cadalign.align(shape, v))
            for views in some
        ]
        for some in (singles, pairs)
    )
    batch = singles * repeats
    rate = len(batch) / section.seconds(lambda: cadalign.align_batch(shape, batch, workers=workers))
    return {
        "category": category,
        "components": len(shape.components),
        "one view ms": section.spread(one),
        "two views ms": float(np.median(two)),
        "batch 1/s": rate,
    }


def _pairs(
    dataset: KeypointNet,
    category: str,
    shape: cadalign.ShapeModel,
    objects: int,
    keypoints: int,
    noise_px: float,
) -> Iterator[list[cadalign.View]]:
    how = {"keypoints": keypoints, "noise_px": noise_px}
    for place, seen in section.unseen_objects(dataset, category, objects, **how):
        known = np.isin(seen.ids, shape.ids)
        points, ids = seen.xyz[seen.rows][known], seen.ids[known]
        turned = cadalign.Alignment(
            _SECOND_VIEW @ seen.gt.rotation, seen.gt.translation, seen.gt.scale
        )
        noise = np.random.default_rng(place).normal(0, noise_px, points[:, :2].shape)
        second = KEYPOINT_CAMERA.project(turned.apply(points)) + noise
        pixels = seen.points_2d[known], second
        yield [cadalign.View(KEYPOINT_CAMERA, each, ids=ids, sigma=noise_px) for each in pixels]


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
        row, found = _unseen(dataset, category, given.seed, objects, noise_px)
        rows.append(row)
        deviations += found
    rows.append(dict.fromkeys(rows[0]) | {"category": "all", "f in 95 %": _held(deviations)})
    yield f"unseen objects in near views, {noise_px:g} px", rows


def _unseen(
    dataset: KeypointNet, category: str, seed: int, objects: int, noise_px: float
) -> tuple[Row, list[float]]:
    """Errors with the focal length known and unknown; the latter's in sigmas."""
    shape = section.learned_shape(dataset, category)
    held_out = dataset.subset(categories=[category], split="val")
    rows, deviations = [], []
    for key in sorted(held_out.ids(category))[:objects]:
        keypoints, rng = held_out[key].keypoints, instance_rng(seed, *key)
        seen = _see_near(keypoints.xyz, keypoints.ids.tolist(), noise_px, rng)
        known, found = (_near(shape, seen, noise_px, focal) for focal in ("known", "estimate"))
        if known is not None and found is not None and found.std is not None:
            rows.append([*_unseen_errors(known, seen), *_unseen_errors(found, seen)])
            deviations.append(float(np.log(found.camera.fx / _NEAR.fx) / found.std.focal))
    known_deg, known_iou, deg, iou = np.median(rows, axis=0).tolist()
    return {
        "category": category,
        "objects": len(rows),
        "R known": known_deg,
        "R unknown deg": deg,
        "ratio of R": deg / known_deg,
        "extents' IoU known": known_iou,
        "unknown": iou,
        "f in 95 %": _held(deviations),
    }, deviations


def _see_near(
    points_3d: FloatArray, ids: Sequence[int], noise_px: float, rng: np.random.Generator
) -> _Seen:
    gt, _ = sample_hull_view(KeypointHull(points_3d), _NEAR, rng=rng, min_visible=0)
    noise = rng.normal(0, noise_px, (len(points_3d), 2))
    return _Seen(points_3d, _NEAR.project(gt.apply(points_3d)) + noise, tuple(ids), _NEAR, gt)


def _near(
    shape: cadalign.ShapeModel, seen: _Seen, noise_px: float, focal: str
) -> cadalign.Result | None:
    camera = seen.camera if focal == "known" else _UNKNOWN
    view = cadalign.View(camera, seen.points_2d, ids=seen.ids, sigma=noise_px)
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
        seen = _see_near(points, range(_POINTS), 1.0, rng)
        bound = _posterior_bound(seen, basis, noise_px=1.0)
        limits.append(
            _sizes(rng.multivariate_normal(np.zeros(len(bound)), bound, section.LIMIT_DRAWS))
        )
        result = _near(shape, seen, 1.0, "estimate")
        if result is None:
            errors.append(np.full((1, len(_ERRORS)), np.inf))
            continue
        turn = vector_from_rotation(result.alignment.rotation @ seen.gt.rotation.T)
        moved = result.alignment.translation - seen.gt.translation
        flat = basis.reshape(modes, -1).T
        shares = np.linalg.lstsq(flat, (result.points_3d - mean).ravel(), rcond=None)[0]
        error = [*turn, *moved, np.log(result.camera.fx / _NEAR.fx), *(shares - weights)]
        errors.append(_sizes(np.array([error])))
    ratios = np.median(np.concatenate(errors), axis=0) / np.median(np.concatenate(limits), axis=0)
    return {"modes K": modes, **dict(zip(_ERRORS, ratios.tolist(), strict=True))}


def _sizes(errors: FloatArray) -> FloatArray:
    """Sizes (n, 4) of errors (n, 7 + K) in the order of `_ERRORS`."""
    parts = np.split(errors, [3, 6, 7], axis=1)
    return np.stack([np.linalg.norm(part, axis=1) for part in parts], axis=1)


def _posterior_bound(seen: _Seen, basis: FloatArray, *, noise_px: float) -> FloatArray:
    """Least covariance (7 + K, 7 + K) of rotation, translation, log focal length and modes.

    Inverse of the keypoints' Fisher information at the truth and that of the modes' prior; what
    the modes leave is noise of the keypoints.
    """
    jacobian = projection_jacobian(seen.points_3d, _NEAR, seen.gt)
    by_place = jacobian[:, :, 3:6] @ seen.gt.rotation
    by_mode = np.einsum("nia,kna->nik", by_place, basis)
    rows = np.concatenate([jacobian[:, :, :6], jacobian[:, :, 9:], by_mode], axis=2)
    noise = noise_px**2 * np.eye(2) + _RESIDUAL**2 * by_place @ by_place.transpose(0, 2, 1)
    information = np.einsum("nik,nil->kl", rows, np.linalg.solve(noise, rows))
    information[7:, 7:] += np.eye(len(basis))
    return np.linalg.inv(information)


def _unseen_errors(result: cadalign.Result, seen: _Seen) -> tuple[float, float]:
    """Rotation error [deg], and intersection over union of the extents up to scale."""
    _, rows, kept = np.intersect1d(result.ids, seen.ids, return_indices=True)
    extents = np.ptp(result.points_3d[rows], axis=0), np.ptp(seen.points_3d[kept], axis=0)
    a, b = (each / np.linalg.norm(each) for each in extents)
    overlap = np.prod(np.minimum(a, b)) / np.prod(np.maximum(a, b))
    return rotation_error(est=result.alignment, gt=seen.gt), float(overlap)


def _held(deviations: Sequence[float]) -> float:
    """Share of focal lengths within their 95 % interval [%]."""
    return section.percent(np.abs(deviations) < section.WITHIN_95)


# Similar models -----------------------------------------------------------------------------------


def similar(
    given: BenchmarkData,
    *,
    sigmas: tuple[float, ...] = (np.inf, 0.5, 0.3, 0.2, 0.1),
    objects: int = 150,
    noise_px: float = 2.0,
) -> Tables:
    """Fits with a model that is only similar: which prior on the stretch helps.

    Models of KeypointNet are seen with all keypoints and aligned with another model of their
    category, drawn at random: `fit` with the noise estimated from the residuals, as `cadalign fit
    --similar`. Median rotation errors [deg], with the IoU of the keypoints' boxes at equal depths.

    Parameters
    ----------
    sigmas : tuple[float, ...]
        Standard deviations of the logarithm of the stretch; inf for no prior.
    objects : int
        Objects of each category.
    noise_px : float
        Noise of the keypoints [px].
    """
    dataset = KeypointNet(given.needed())
    rows = [
        _by_prior(category, dataset[category], sigmas, objects, noise_px)
        for category in dataset.categories
    ]
    yield "Median rotation error in degrees (box IoU), by prior", rows


def _by_prior(
    category: str,
    models: Sequence[AnnotatedModel],
    sigmas: tuple[float, ...],
    objects: int,
    noise_px: float,
) -> Row:
    usable = [each for each in models if len(each.keypoints.xyz) >= _LEAST_KEYPOINTS]
    pairs = []
    for each in usable[:: max(1, len(usable) // objects)]:
        model, seen = _pair(each, [other for other in usable if other is not each], noise_px)
        if len(model) >= _LEAST_KEYPOINTS:
            pairs.append((model, seen))
    row: Row = {"category": category, "objects": len(pairs)}
    for sigma in sigmas:
        errors = [_similar_errors(*each, sigma) for each in pairs]
        name = "none" if np.isinf(sigma) else f"{sigma:g}"
        row[name] = tuple(np.nanmedian(errors, axis=0).tolist())
    return row


def _pair(
    seen: AnnotatedModel, others: Sequence[AnnotatedModel], noise_px: float
) -> tuple[FloatArray, _Seen]:
    rng = instance_rng(0, seen.category, seen.model_id, "similar")
    other = others[int(rng.integers(len(others)))].keypoints
    own = dict(zip(seen.keypoints.ids.tolist(), seen.keypoints.xyz, strict=True))
    kept = [row for row, name in enumerate(other.ids.tolist()) if name in own]
    ids = tuple(other.ids[kept].tolist())
    points = np.array([own[name] for name in ids]).reshape(-1, 3)
    pose = look_at(
        azimuth=rng.uniform(0, 360), elevation=rng.uniform(0, 60), distance=rng.uniform(1.5, 3)
    )
    pixels = KEYPOINT_CAMERA.project(pose.apply(points))
    pixels += noise_px * rng.standard_normal(pixels.shape)
    return other.xyz[kept], _Seen(points, pixels, ids, KEYPOINT_CAMERA, pose)


def _similar_errors(model: FloatArray, seen: _Seen, sigma: float) -> tuple[float, float]:
    """Rotation error [degrees] and IoU of the keypoints' boxes at equal depths of their centres."""
    prior = None if np.isinf(sigma) else sigma
    result = section.attempt(
        cadalign.fit, model, seen.points_2d, seen.camera, sigma=None, stretch_sigma=prior
    )
    if result is None:
        return 180.0, 0.0
    est_box, gt_box = (
        cadalign.Box.from_model([points.min(0), points.max(0)], pose)
        for points, pose in ((model, result.alignment), (seen.points_3d, seen.gt))
    )
    factor = np.linalg.norm(gt_box.center) / np.linalg.norm(est_box.center)
    placed = cadalign.Box(factor * est_box.center, est_box.rotation, factor * est_box.extents)
    thick = min(est_box.extents.min(), gt_box.extents.min()) > 1e-6
    iou = box_iou(est=placed, gt=gt_box) if thick else np.nan
    return rotation_error(est=result.alignment, gt=seen.gt), iou
