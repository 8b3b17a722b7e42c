"""Cameras that are not known: lenses of photos, and several objects of one photo."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.section import BenchmarkData, RatioTable, Row
from cadalign import (
    Alignment,
    Camera,
    FocalPrior,
    Model,
    Result,
    SceneObject,
    ShapeModel,
    Size,
    View,
    align,
    align_scene,
)
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet
from cadalign.datasets.photos.kitti import KittiLabel, read_labels
from cadalign.errors import CadalignError
from cadalign.evaluation.experiments.unseen import UnseenOptions
from cadalign.evaluation.instances.unseen import UnseenTasks, observe_object
from cadalign.evaluation.simulation.problems import Problem, simulate_standing_boxes
from cadalign.geometry.metrics import rotation_error
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.render import look_at
from cadalign.seeding import instance_rng

_SIDE, _HEIGHT = 640, 480
_UNKNOWN = Camera.without_focal(_SIDE, _HEIGHT)
_WITHIN_95, _VIEWPOINT_DEG = 1.96, 30.0
_SHORTEST_MM, _MEDIAN_MM, _SHAPE, _LONGEST_MM, _FILM_MM = 14.0, 17.0, 0.8, 200.0, 36.0
_SCALE_SIGMA, _TILT_SIGMA = 0.3, math.radians(1.0)
_WIDTHS = 0.06  # relative standard deviation of cars' widths
_PRIORS = ("none", "usual", "EXIF", "known")


# Lenses -------------------------------------------------------------------------------------------


@dataclass
class PhotoLenses:
    """Unknown focal lengths of photos' lenses: what the prior of usual lenses and EXIF data bring.

    Objects of the split val fill their images, through lenses of the distribution of focal lengths
    of `FocalPrior.of_usual_lenses`. Models are the nearest one of the split train, only similar, or
    the learned shape of the category.
    """

    categories: tuple[str, ...] = ("chair", "airplane", "mug")
    """Categories."""
    objects: int = 40
    """Objects of each category."""
    noise_px: float = 2.0
    """Standard deviation of the keypoints, in pixels."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure all categories."""
        dataset = KeypointNet(given.needed("keypointnet"))
        for category in self.categories:
            shape = ShapeModel.from_dataset(dataset, category, split="train", meshes=False)
            seen = list(self._seen(dataset, category, shape, given.seed))
            yield RatioTable(
                f"{category}, learned shape", [self._row(shape, seen, each) for each in _PRIORS]
            )
            mean = Model(
                points_3d=shape.components[0].mean[: len(shape.ids)],
                ids=shape.ids,
                shape_sigma=0.05,
            )
            yield RatioTable(
                f"{category}, its mean as a similar model",
                [self._row(mean, seen, each) for each in _PRIORS],
            )

    def _seen(
        self, dataset: KeypointNet, category: str, shape: ShapeModel, seed: int
    ) -> Iterator[tuple[Alignment, Camera, FloatArray, tuple[int, ...]]]:
        """Truth, camera, keypoints and their ids of every object."""
        options = UnseenOptions(root=dataset.root, categories=(category,), noise_px=self.noise_px)
        tasks = UnseenTasks(dataset, options)
        for place in range(0, len(tasks), -(-len(tasks) // self.objects)):
            one = observe_object(tasks[place], options)
            known = np.isin(one.ids, shape.ids)
            points, ids = one.xyz[one.rows][known], one.ids[known]
            if len(ids) < 6:
                continue
            rng = instance_rng(seed, f"{category}/{place}")
            spread = _SHORTEST_MM + _MEDIAN_MM * float(np.exp(_SHAPE * rng.normal()))
            focal = _SIDE * min(spread, _LONGEST_MM) / _FILM_MM
            camera = Camera(_SIDE, _HEIGHT, focal, focal, (_SIDE - 1) / 2, (_HEIGHT - 1) / 2)
            distance = 0.5 + focal / (0.6 * _HEIGHT)  # of the middle of an object of diagonal 1
            pose = look_at(
                azimuth=rng.uniform(0, 360), elevation=rng.uniform(5, 40), distance=distance
            )
            pixels = camera.project(pose.apply(points))
            pixels += self.noise_px * rng.normal(size=pixels.shape)
            yield pose, camera, pixels, tuple(ids.tolist())

    def _row(self, model: Any, seen: Sequence[tuple[Any, ...]], prior: str) -> Row:
        errors, focals, holds = [], [], []
        for number, (pose, camera, pixels, ids) in enumerate(seen):
            rng = instance_rng(number, "exif")
            stated = FocalPrior(camera.fx * float(np.exp(0.05 * rng.normal())), 0.05)
            options: dict[str, Any] = {
                "none": {"focal": "estimate", "focal_prior": None},
                "usual": {"focal": "estimate"},
                "EXIF": {"focal": "estimate", "focal_prior": stated},
                "known": {},
            }[prior]
            given = camera if prior == "known" else _UNKNOWN
            try:
                result = align(model, View(given, pixels, ids=ids, sigma=self.noise_px), **options)
            except CadalignError:
                errors.append(180.0)
                continue
            errors.append(rotation_error(est=result.alignment, gt=pose))
            focals.append(abs(np.log(result.camera.fx / camera.fx)))
            assert result.std is not None
            holds.append(focals[-1] <= _WITHIN_95 * result.std.focal)
        beyond = [value for value in focals if np.exp(value) > 3]
        return {
            "prior": prior,
            "R deg": (float(np.median(errors)), float(np.percentile(errors, 90))),
            "within 30 deg %": 100 * float(np.mean(np.array(errors) < _VIEWPOINT_DEG)),
            "focal off %": 100 * float(np.median(focals)) if prior != "known" else 0.0,
            "off by 3 times %": 100 * len(beyond) / len(seen),
            "in 95 % interval": 100 * float(np.mean(holds)) if prior != "known" else 100.0,
        }


# Several objects of one photo ---------------------------------------------------------------------


@dataclass
class Scenes:
    """Objects of one photo, alone and together: boxes of unknown stretch, and cars of KITTI.

    The boxes' focal length is unknown. The cars stand where KITTI's labels of a street have them,
    and are the mean car stretched to the labels' sizes; their keypoints are simulated.
    """

    scenes: int = 60
    """Scenes of boxes for each number of objects."""
    noise_px: float = 1.0
    """Standard deviation of the boxes' keypoints, in pixels; of the cars it is three times that."""
    kitti: Path | None = None
    """Folder of KITTI's cars; by default the one in CADALIGN_DATA."""

    def run(self, given: BenchmarkData) -> Iterator[RatioTable]:
        """Measure boxes and cars."""
        rows = [
            self._boxes(given.seed, count, share)
            for count in (1, 2, 4)
            for share in (("focal",), ("focal", "gravity"))[: 1 + (count > 1)]
        ]
        yield RatioTable("boxes of unknown stretch, unknown focal length", rows)
        folder = self.kitti
        if folder is None and given.keypointnet is not None:
            folder = given.keypointnet.parent / "real" / "kitti_cars"
        if folder is not None and folder.is_dir():
            yield RatioTable("cars of KITTI's labels, 2 to 4 in an image", self._cars(folder))

    def _boxes(self, seed: int, count: int, share: tuple[str, ...]) -> Row:
        focal, found = 700.0, defaultdict(list)
        camera = Camera(_SIDE, _HEIGHT, focal, focal, (_SIDE - 1) / 2, (_HEIGHT - 1) / 2)
        for number in range(self.scenes):
            rng = instance_rng(seed, f"{number}")
            boxes = simulate_standing_boxes(
                rng, objects=count, camera=camera, noise_px=self.noise_px
            )
            objects = [
                SceneObject(
                    Model(
                        points_3d=each.points_3d,
                        bounds=boxes.BOUNDS,
                        stretch_sigma=_SCALE_SIGMA,
                    ),
                    View(_UNKNOWN, each.points_2d),
                )
                for each in boxes.problems
            ]
            scene = align_scene(objects, share=share)
            found["bound"].append(_focal_bound(boxes.problems, share, self.noise_px))
            off = float(np.log(scene.camera.fx / focal))
            found["focal"].append(off)
            found["held"].append(abs(off) < _WITHIN_95 * scene.focal_std)
            for result, each in zip(scene.results, boxes.problems, strict=True):
                truth = each.alignment
                if isinstance(result, Result):
                    found["R"].append(rotation_error(est=result.alignment, gt=truth))
                    depth = result.alignment.translation[2] / truth.translation[2]
                    found["depth"].append(abs(float(np.log(depth))))
        return {
            "objects": count,
            "share": ", ".join(share),
            "focal rms %": 100 * float(np.sqrt(np.mean(np.square(found["focal"])))),
            "bound %": 100 * float(np.sqrt(np.mean(np.square(found["bound"])))),
            "in 95 % interval": 100 * float(np.mean(found["held"])),
            "R deg": float(np.median(found["R"])),
            "depth %": 100 * float(np.median(found["depth"])),
        }

    def _cars(self, folder: Path) -> list[Row]:
        tracks = json.loads((folder / "car_tracks.json").read_text())
        mean = np.array(tracks["model_xyz"])
        frames: dict[int, list[KittiLabel]] = defaultdict(list)
        for label in read_labels(folder / "label_02" / "0010.txt", tracking=True):
            if isinstance(label, KittiLabel) and label.kind == "Car" and 5 < label.numbers[12] < 35:
                frames[label.frame or 0].append(label)
        seen = {k: each for k, each in frames.items() if 2 <= len(each) <= 4 and k % 2 == 0}
        found: dict[str, dict[str, list[float]]] = {}
        for frame, labels in seen.items():
            for name, scene, truths in self._car_scenes(frame, labels, mean):
                columns = found.setdefault(name, defaultdict(list))
                for result, truth in zip(scene, truths, strict=True):
                    _add_car(columns, result, truth, mean)
        return [
            {"method": name, "cars": len(each["yaw deg"])}
            | {key: (float(np.median(v)), float(np.percentile(v, 90))) for key, v in each.items()}
            for name, each in found.items()
        ]

    def _car_scenes(
        self, frame: int, labels: Sequence[KittiLabel], mean: FloatArray
    ) -> Iterator[tuple[str, Sequence[Any], list[Alignment]]]:
        """Results and truths of the cars of a frame, by every method."""
        camera = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9)
        rng = instance_rng(frame, "kitti")
        sigma = 3 * self.noise_px
        truths = [_pose_of(label, mean) for label in labels]
        pixels = [camera.project(each.apply(mean)) for each in truths]
        pixels = [each + sigma * rng.normal(size=each.shape) for each in pixels]
        model = Model(points_3d=mean, stretch_sigma=0.1, up_axis="z")
        size = Size(width=float(np.ptp(mean[:, 0])), sigma=_WIDTHS)
        ground = {"up": (0.0, -1.0, 0.0), "camera_height": 1.65, "camera_height_sigma": 0.03}
        for name, evidence, share in (
            ("each alone", {}, ()),
            ("each on the ground", ground, ()),
            ("together, gravity shared", {}, ("gravity",)),
            ("together, on one ground", ground, ("ground",)),
        ):
            objects = [
                SceneObject(model, View(camera, uv, sigma=sigma, **evidence), size) for uv in pixels
            ]
            yield name, align_scene(objects, share=share).results, truths


def _focal_bound(problems: Sequence[Problem], share: Sequence[str], noise_px: float) -> float:
    """Cramer-Rao bound of the log focal length with the priors, by differences about the truth.

    Unknowns are the log focal length, the pose and two log scales of each object, and gravity where
    it is shared.
    """

    def residuals(unknowns: FloatArray) -> FloatArray:
        focal, gravity, *objects = np.split(unknowns, [1, 4, *range(12, len(unknowns), 8)])
        rows = [focal / FocalPrior.of_usual_lenses(_SIDE, _HEIGHT).relative_sigma]
        for each, moved in zip(problems, objects, strict=True):
            camera, truth = each.camera, each.alignment
            turn = rotation_from_vector(moved[:3]) @ truth.rotation
            scale = truth.scale * np.exp([0.0, *moved[6:]])
            pose = Alignment(turn, truth.translation + moved[3:6], scale)
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


def _pose_of(label: KittiLabel, mean: FloatArray) -> Alignment:
    """Pose of the mean car stretched to a label's box; x lateral, y to the rear, z up."""
    height, width, length, *location, rotation_y = label.numbers[7:14]
    low, high = mean.min(axis=0), mean.max(axis=0)
    scale = np.array([width, length, height]) / (high - low)
    yaw = rotation_from_vector(np.array([0.0, rotation_y, 0.0]))
    in_box = yaw @ np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    lowest = in_box @ (scale * [(low + high)[0] / 2, (low + high)[1] / 2, low[2]])
    return Alignment(in_box, np.array(location) - lowest, scale)


def _add_car(
    columns: Mapping[str, list[float]], result: Any, truth: Alignment, mean: FloatArray
) -> None:
    """Add the errors of a car; one without result counts as wrong as can be."""
    if not isinstance(result, Result):
        columns["yaw deg"].append(180.0)
        columns["depth %"].append(100.0)
        columns["length %"].append(100.0)
        return
    center = mean.mean(axis=0)[None]
    columns["yaw deg"].append(rotation_error(est=result.alignment, gt=truth))
    depths = result.alignment.apply(center)[0, 2] / truth.apply(center)[0, 2]
    columns["depth %"].append(100 * abs(float(depths) - 1))
    lengths = result.alignment.scale[1] / truth.scale[1]
    columns["length %"].append(100 * abs(float(lengths) - 1))
