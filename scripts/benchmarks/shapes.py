"""Models that are not the object: learned shapes, unknown focal lengths, and similar models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.section import (
    LIMIT_DRAWS,
    BenchmarkData,
    RatioTable,
    Row,
    processor_seconds,
    seconds,
)
from cadalign import Alignment, Box, Camera, Result, ShapeModel, View, align, align_batch, fit
from cadalign.arrays import FloatArray
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import CadalignError
from cadalign.evaluation.experiments.unseen import UnseenOptions
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.unseen import UnseenTasks, observe_object
from cadalign.geometry.metrics import box_iou, rotation_error
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.render import look_at
from cadalign.seeding import instance_rng
from cadalign.solvers.projection import projection_jacobian

_SECOND_VIEW = rotation_from_vector(np.array([0.0, np.radians(25.0), 0.0]))
_KNOWN = Camera(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
"""An object that fills its image is near, at some 1.3 of its diagonals."""
_UNKNOWN = Camera.without_focal(_KNOWN.width, _KNOWN.height)
_POINTS = 14
_MODE_LENGTH, _RESIDUAL = 0.06, 0.005
_WITHIN_95 = 1.96
_ERRORS = ("R", "t", "f", "shape")
_LEAST_KEYPOINTS = 6


# Times --------------------------------------------------------------------------------------------


@dataclass
class Align:
    """Time of `align` with learned shapes: one view, two views, and a batch.

    Objects are those of the split val, seen with noisy keypoints; shape models are learned from the
    split train. Times of single objects are those of the processor, warm and on one thread.
    """

    categories: tuple[str, ...] = ("chair", "airplane", "mug")
    """Categories."""
    objects: int = 40
    """Objects of each category."""
    keypoints: int = 14
    """Most keypoints of an object."""
    noise_px: float = 2.0
    """Standard deviation of the keypoints, in pixels."""
    repeats: int = 5
    """Times that the batch holds every object."""
    workers: int = 2
    """Threads of the batch."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure all categories."""
        dataset = KeypointNet(given.needed("keypointnet"))
        yield RatioTable(
            "align with a learned shape", [self._row(dataset, c) for c in self.categories]
        )

    def _row(self, dataset: KeypointNet, category: str) -> Row:
        shape = ShapeModel.from_dataset(dataset, category, split="train", meshes=False)
        pairs = list(self._pairs(dataset, category, shape))
        singles = [views[:1] for views in pairs]
        for views in singles[:2] + pairs[:2]:  # compile
            align(shape, views)
        one, two = (
            [1e3 * processor_seconds(lambda v=views: align(shape, v)) for views in objects]
            for objects in (singles, pairs)
        )
        batch = singles * self.repeats
        rate = len(batch) / seconds(lambda: align_batch(shape, batch, workers=self.workers))
        return {
            "category": category,
            "components": len(shape.components),
            "one view ms": (float(np.median(one)), float(np.percentile(one, 90))),
            "two views ms": float(np.median(two)),
            "batch 1/s": rate,
        }

    def _pairs(
        self, dataset: KeypointNet, category: str, shape: ShapeModel
    ) -> Iterator[list[View]]:
        """Two views of every object."""
        options = UnseenOptions(
            root=dataset.root,
            categories=(category,),
            keypoints=self.keypoints,
            noise_px=self.noise_px,
        )
        tasks = UnseenTasks(dataset, options)
        for place in range(0, len(tasks), -(-len(tasks) // self.objects)):
            seen = observe_object(tasks[place], options)
            known = np.isin(seen.ids, shape.ids)
            points, ids = seen.xyz[seen.rows][known], seen.ids[known]
            turned = Alignment(_SECOND_VIEW @ seen.gt.rotation, seen.gt.translation, seen.gt.scale)
            noise = np.random.default_rng(place).normal(0, self.noise_px, points[:, :2].shape)
            second = KEYPOINT_CAMERA.project(turned.apply(points)) + noise
            pixels: Sequence[FloatArray] = (seen.points_2d[known], second)
            yield [View(KEYPOINT_CAMERA, each, ids=ids, sigma=self.noise_px) for each in pixels]


# Unknown focal length -----------------------------------------------------------------------------


@dataclass
class FocalShapes:
    """Unknown focal lengths beside learned shapes: the Cramer-Rao limit, and unseen objects.

    The first table's objects are drawn from a shape model, the second's are those of KeypointNet's
    split val, with models learned from its split train, in near views.
    """

    categories: tuple[str, ...] = ("airplane", "bathtub", "bottle", "chair", "mug")
    """Categories of the unseen objects."""
    objects: int = 60
    """Objects per category, and drawn objects per number of modes five times as many."""
    noise_px: float = 2.0
    """Standard deviation of the unseen objects' keypoints, in pixels."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure drawn objects, and with KeypointNet unseen ones."""
        title = f"{_POINTS} keypoints, 1 px: median errors over the limit's of 7 + K unknowns"
        rng = np.random.default_rng
        yield RatioTable(title, [_drawn(rng(given.seed), k, 5 * self.objects) for k in (1, 3, 5)])
        if given.keypointnet is None:
            return
        dataset, rows, deviations = KeypointNet(given.keypointnet), [], []
        for category in self.categories:
            row, found = self._unseen(dataset, category, given.seed)
            rows.append(row)
            deviations += found
        rows.append(dict.fromkeys(rows[0]) | {"category": "all", "f in 95 %": _held(deviations)})
        yield RatioTable(f"unseen objects in near views, {self.noise_px:g} px", rows)

    def _unseen(self, dataset: KeypointNet, category: str, seed: int) -> tuple[Row, list[float]]:
        """Errors with the focal length known and unknown; errors of the latter in deviations."""
        shape = ShapeModel.from_dataset(dataset, category, split="train", meshes=False)
        objects = dataset.subset(categories=[category], split="val")
        rows, deviations = [], []
        for key in sorted(objects.ids(category))[: self.objects]:
            keypoints, rng = objects[key].keypoints, instance_rng(seed, *key)
            ids = keypoints.ids.tolist()
            seen = _see(keypoints.xyz, ids, noise_px=self.noise_px, rng=rng)
            known, found = (
                _estimate(shape, seen, camera, noise_px=self.noise_px)
                for camera in (_KNOWN, _UNKNOWN)
            )
            if known is None or found is None or found.std is None:
                continue
            rows.append([*_unseen_errors(known, seen), *_unseen_errors(found, seen)])
            deviations.append(float(np.log(found.camera.fx / _KNOWN.fx) / found.std.focal))
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


@dataclass(frozen=True)
class _Sighting:
    """Keypoints (n, 3) of an object, their noisy places (n, 2) [px], ids and the true pose."""

    points_3d: FloatArray
    points_2d: FloatArray
    ids: tuple[int, ...]
    gt: Alignment


def _see(
    points_3d: FloatArray, ids: Sequence[int], *, noise_px: float, rng: np.random.Generator
) -> _Sighting:
    """Draw a near view of an object, and the noise of its keypoints."""
    gt, _ = sample_hull_view(KeypointHull(points_3d), _KNOWN, rng=rng, min_visible=0)
    noise = rng.normal(0, noise_px, (len(points_3d), 2))
    return _Sighting(points_3d, _KNOWN.project(gt.apply(points_3d)) + noise, tuple(ids), gt)


def _estimate(
    shape: ShapeModel, seen: _Sighting, camera: Camera, *, noise_px: float
) -> Result | None:
    """Alignment of a shape model; None where none is found."""
    view = View(camera, seen.points_2d, ids=seen.ids, sigma=noise_px)
    try:
        return align(shape, view, focal="known" if camera is _KNOWN else "estimate")
    except CadalignError:
        return None


def _drawn(rng: np.random.Generator, modes: int, objects: int) -> Row:
    """Median errors on objects of the model, over those of draws from the Cramer-Rao bound."""
    errors, limits = [], []
    for _ in range(objects):
        mean = rng.uniform(-0.35, 0.35, (_POINTS, 3))
        basis = rng.normal(0, _MODE_LENGTH, (modes, _POINTS, 3))
        shape = ShapeModel.from_basis(mean, basis, np.ones(modes), residual_sigma=_RESIDUAL)
        weights = rng.normal(size=modes)
        points = mean + np.tensordot(weights, basis, 1)
        points += rng.normal(0, _RESIDUAL, points.shape)
        seen = _see(points, range(_POINTS), noise_px=1.0, rng=rng)
        bound = _posterior_bound(seen, basis, noise_px=1.0)
        limits.append(_sizes(rng.multivariate_normal(np.zeros(len(bound)), bound, LIMIT_DRAWS)))
        result = _estimate(shape, seen, _UNKNOWN, noise_px=1.0)
        if result is None:
            errors.append(np.full((1, len(_ERRORS)), np.inf))
            continue
        turn = Rotation.from_matrix(result.alignment.rotation @ seen.gt.rotation.T).as_rotvec()
        moved = result.alignment.translation - seen.gt.translation
        shares = np.linalg.lstsq(
            basis.reshape(modes, -1).T, (result.points_3d - mean).ravel(), rcond=None
        )[0]
        error = [*turn, *moved, np.log(result.camera.fx / _KNOWN.fx), *(shares - weights)]
        errors.append(_sizes(np.array([error])))
    ratios = np.median(np.concatenate(errors), axis=0) / np.median(np.concatenate(limits), axis=0)
    return {"modes K": modes, **dict(zip(_ERRORS, ratios.tolist(), strict=True))}


def _sizes(errors: FloatArray) -> FloatArray:
    """Sizes (n, 4) of errors (n, 7 + K) in the order of `_ERRORS`."""
    parts = (errors[:, :3], errors[:, 3:6], errors[:, 6:7], errors[:, 7:])
    return np.stack([np.linalg.norm(part, axis=1) for part in parts], axis=1)


def _posterior_bound(seen: _Sighting, basis: FloatArray, *, noise_px: float) -> FloatArray:
    """Least covariance (7 + K, 7 + K) of rotation, translation, log focal length and modes.

    Inverse of the keypoints' Fisher information at the truth and that of the modes' prior; what
    the modes leave is noise of the keypoints.
    """
    jacobian = projection_jacobian(seen.points_3d, _KNOWN, seen.gt)
    by_place = jacobian[:, :, 3:6] @ seen.gt.rotation
    by_mode = np.einsum("nia,kna->nik", by_place, basis)
    rows = np.concatenate([jacobian[:, :, :6], jacobian[:, :, 9:], by_mode], axis=2)
    noise = noise_px**2 * np.eye(2) + _RESIDUAL**2 * by_place @ by_place.transpose(0, 2, 1)
    information = np.einsum("nik,nil->kl", rows, np.linalg.solve(noise, rows))
    information[7:, 7:] += np.eye(len(basis))
    return np.linalg.inv(information)


def _unseen_errors(result: Result, seen: _Sighting) -> tuple[float, float]:
    """Rotation error [deg], and intersection over union of the extents up to scale."""
    rows = [result.ids.index(name) for name in seen.ids if name in result.ids]
    kept = [row for row, name in enumerate(seen.ids) if name in result.ids]
    extents = np.ptp(result.points_3d[rows], axis=0), np.ptp(seen.points_3d[kept], axis=0)
    a, b = (each / np.linalg.norm(each) for each in extents)
    overlap = np.prod(np.minimum(a, b)) / np.prod(np.maximum(a, b))
    return rotation_error(est=result.alignment, gt=seen.gt), float(overlap)


def _held(deviations: Sequence[float]) -> float:
    """Share of focal lengths within their 95 % interval [%]."""
    return 100 * float(np.mean(np.abs(deviations) < _WITHIN_95))


# Similar models -----------------------------------------------------------------------------------


@dataclass
class Similar:
    """Fits with a model that is only similar: which prior on the stretch helps.

    Models of KeypointNet are seen with all keypoints and aligned with another model of their
    category, drawn at random: `fit` with the noise estimated from the residuals, as `cadalign fit
    --similar`. Median rotation errors [deg], with the IoU of the keypoints' boxes at equal depths.
    """

    sigmas: tuple[float, ...] = (np.inf, 0.5, 0.3, 0.2, 0.1)
    """Standard deviations of the logarithm of the stretch; inf for no prior."""
    objects: int = 150
    """Objects of each category."""
    noise_px: float = 2.0
    """Noise of the keypoints [px]."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure every category and prior."""
        dataset = KeypointNet(given.needed("keypointnet"))
        rows = [self._row(category, dataset[category]) for category in dataset.categories]
        yield RatioTable("Median rotation error in degrees (box IoU), by prior", rows)

    def _row(self, category: str, models: Sequence[AnnotatedModel]) -> Row:
        usable = [each for each in models if len(each.keypoints.xyz) >= _LEAST_KEYPOINTS]
        problems = [
            _similar_problem(each, [other for other in usable if other is not each], self.noise_px)
            for each in usable[:: max(1, len(usable) // self.objects)]
        ]
        problems = [each for each in problems if len(each.model) >= _LEAST_KEYPOINTS]
        row: Row = {"category": category, "objects": len(problems)}
        for sigma in self.sigmas:
            errors = [_similar_errors(each, sigma) for each in problems]
            name = "none" if np.isinf(sigma) else f"{sigma:g}"
            row[name] = tuple(np.nanmedian(errors, axis=0).tolist())
        return row


@dataclass(frozen=True, eq=False)
class _SimilarProblem:
    """Keypoints (n, 3) of a model, those of the object, their image (n, 2), and the true pose."""

    model: FloatArray
    object: FloatArray
    points_2d: FloatArray
    truth: Alignment


def _similar_problem(
    seen: AnnotatedModel, others: Sequence[AnnotatedModel], noise: float
) -> _SimilarProblem:
    """A random view of an object, and a random other model."""
    rng = instance_rng(0, seen.category, seen.model_id, "similar")
    other = others[int(rng.integers(len(others)))].keypoints
    own = dict(zip(seen.keypoints.ids.tolist(), seen.keypoints.xyz, strict=True))
    ids = zip(other.ids.tolist(), other.xyz, strict=True)
    pairs = [(own[k], xyz) for k, xyz in ids if k in own]
    points, model = (np.array(each).reshape(-1, 3) for each in zip(*pairs, strict=True))
    pose = look_at(
        azimuth=rng.uniform(0, 360), elevation=rng.uniform(0, 60), distance=rng.uniform(1.5, 3)
    )
    pixels = KEYPOINT_CAMERA.project(pose.apply(points))
    return _SimilarProblem(model, points, pixels + noise * rng.standard_normal(pixels.shape), pose)


def _similar_errors(problem: _SimilarProblem, sigma: float) -> tuple[float, float]:
    """Rotation error [degrees] and IoU of the keypoints' boxes at equal depths of their centres."""
    prior = None if np.isinf(sigma) else sigma
    try:
        est = fit(
            problem.model, problem.points_2d, KEYPOINT_CAMERA, sigma=None, stretch_sigma=prior
        ).alignment
    except CadalignError:
        return 180.0, 0.0
    est_box, gt_box = (
        Box.from_model([points.min(0), points.max(0)], pose)
        for points, pose in ((problem.model, est), (problem.object, problem.truth))
    )
    factor = np.linalg.norm(gt_box.center) / np.linalg.norm(est_box.center)
    placed = Box(factor * est_box.center, est_box.rotation, factor * est_box.extents)
    thick = min(est_box.extents.min(), gt_box.extents.min()) > 1e-6
    iou = box_iou(est=placed, gt=gt_box) if thick else np.nan
    return rotation_error(est=est, gt=problem.truth), iou
