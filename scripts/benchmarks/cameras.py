"""Cameras that are not known: lenses of photos, and several objects of one photo."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import cadalign
from benchmarks import section
from benchmarks.cars import car_scenes
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.unseen import UnseenObject
from cadalign.evaluation.simulation import UNIT_BOUNDS, Problem, simulate_standing_boxes
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.metrics import rotation_error
from cadalign.render import look_at

_CAMERA = cadalign.Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
_UNKNOWN = cadalign.Camera.without_focal(_CAMERA.width, _CAMERA.height)
_SHORTEST_MM, _MEDIAN_MM, _SHAPE, _LONGEST_MM, _FILM_MM = 14.0, 17.0, 0.8, 200.0, 36.0
_VIEWPOINT_DEG = 30.0
_LEAST_KEYPOINTS = 6
_PRIORS = ("none", "usual", "EXIF", "known")
_SCALE_SIGMA, _TILT_SIGMA = 0.3, np.radians(1.0)


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


def scenes(
    given: BenchmarkData, *, scenes: int = 60, noise_px: float = 1.0, kitti: Path | None = None
) -> Tables:
    """Objects of one photo, alone and together: boxes of unknown stretch, and cars of KITTI.

    The boxes' focal length is unknown. The cars stand where KITTI's labels of a street have them,
    and are the mean car stretched to the labels' sizes; their keypoints are simulated.

    Parameters
    ----------
    scenes : int
        Scenes of boxes for each number of objects.
    noise_px : float
        Standard deviation of the boxes' keypoints, in pixels; of the cars it is three times that.
    kitti : Path | None
        Folder of KITTI's cars; by default the one in CADALIGN_DATA.
    """
    rows = [_boxes(given.seed, 1, ("focal",), scenes, noise_px)]
    for count in (2, 4):
        for share in (("focal",), ("focal", "gravity")):
            rows.append(_boxes(given.seed, count, share, scenes, noise_px))
    yield "boxes of unknown stretch, unknown focal length", rows
    folder = kitti or (given.keypointnet and given.real("kitti_cars"))
    if folder is not None and folder.is_dir():
        rows = car_scenes(folder, 3 * noise_px)
        yield "cars of KITTI's labels, 2 to 4 in an image", rows


def _boxes(seed: int, count: int, share: tuple[str, ...], scenes: int, noise_px: float) -> Row:
    found = defaultdict(list)
    for number in range(scenes):
        rng = instance_rng(seed, f"{number}")
        boxes, _ = simulate_standing_boxes(rng, objects=count, camera=_CAMERA, noise_px=noise_px)
        how = {"bounds": UNIT_BOUNDS, "stretch_sigma": _SCALE_SIGMA}
        objects = [
            cadalign.SceneObject(
                cadalign.Model(points_3d=each.points_3d, **how),
                cadalign.View(_UNKNOWN, each.points_2d),
            )
            for each in boxes
        ]
        scene = cadalign.align_scene(objects, share=share)
        off = float(np.log(scene.camera.fx / _CAMERA.fx))
        found["bound"].append(_focal_bound(boxes, share, noise_px))
        found["focal"].append(off)
        found["held"].append(abs(off) < section.WITHIN_95 * scene.focal_std)
        for result, each in zip(scene.results, boxes, strict=True):
            if isinstance(result, cadalign.Result):
                est, gt = result.alignment, each.alignment
                found["R"].append(rotation_error(est=est, gt=gt))
                found["depth"].append(abs(np.log(est.translation[2] / gt.translation[2])))
    focal, bound = (float(np.sqrt(np.mean(np.square(found[k])))) for k in ("focal", "bound"))
    return {
        "objects": count,
        "share": ", ".join(share),
        "focal rms %": 100 * focal,
        "bound %": 100 * bound,
        "in 95 % interval": section.percent(found["held"]),
        "R deg": float(np.median(found["R"])),
        "depth %": 100 * float(np.median(found["depth"])),
    }


def _focal_bound(problems: Sequence[Problem], share: Sequence[str], noise_px: float) -> float:
    """Cramer-Rao bound of the log focal length with the priors, by differences about the truth.

    Unknowns are the log focal length, the pose and two log scales of each object, and gravity where
    it is shared.
    """

    def residuals(unknowns: FloatArray) -> FloatArray:
        focal, gravity, *objects = np.split(unknowns, [1, 4, *range(12, len(unknowns), 8)])
        prior = cadalign.FocalPrior.of_usual_lenses(_CAMERA.width, _CAMERA.height)
        rows = [focal / prior.relative_sigma]
        for each, moved in zip(problems, objects, strict=True):
            camera, truth = each.camera, each.alignment
            turn = rotation_from_vector(moved[:3]) @ truth.rotation
            scale = truth.scale * np.exp([0.0, *moved[6:]])
            pose = cadalign.Alignment(turn, truth.translation + moved[3:6], scale)
            seen = camera.with_focal(camera.fx * float(np.exp(focal[0])))
            rows += [seen.project(pose.apply(each.points_3d)).ravel() / noise_px]
            rows += [moved[6:] / _SCALE_SIGMA]
            if "gravity" in share:
                rows += [(turn[:, 1] - gravity) / _TILT_SIGMA]
        return np.concatenate(rows)

    middle, step = np.zeros(4 + 8 * len(problems)), 1e-5
    used = [k for k in range(len(middle)) if "gravity" in share or not 1 <= k < 4]
    columns = np.eye(len(middle))[used] * step
    jacobian = np.stack(
        [(residuals(middle + each) - residuals(middle - each)) / (2 * step) for each in columns]
    )
    return float(np.sqrt(np.linalg.inv(jacobian @ jacobian.T)[0, 0]))
