"""Measure what masks add to keypoints: exact ones, damaged ones, those of other objects.

Views of models with meshes, stretched by 0.5 to 2, their visible keypoints with noise of 1 px, and
masks of 640 x 480 pixels. The bound is that of Cramer and Rao for keypoints and contour together,
with the deviation and correlation that the contour has at the true alignment. Prints medians and
writes them to a JSON file.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tyro
from common import SeededBenchmark, new_table, write_results
from rich.console import Console

from cadalign import Camera, Model, View, align
from cadalign.datasets import AnnotatedModel, KeypointNet, write_sample_dataset
from cadalign.errors import CadalignError, RenderError
from cadalign.estimation.contours.fit import contour_bound
from cadalign.evaluation.accuracy.masks import DAMAGES, damaged_mask
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.metrics import alignment_box_iou, rotation_error
from cadalign.render import Scene, cast_geometry, sample_view

CAMERA = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
NOISE_PX = 1.0
STRETCH = 2.0
LEAST_KEYPOINTS = 4
KINDS = (*DAMAGES, "border")
BOUND_DRAWS = 20


@dataclass
class MasksArguments(SeededBenchmark):
    """Arguments of the benchmark."""

    keypointnet: Path | None = None
    """KeypointNet beside ShapeNet's models; by default the sample dataset alone."""
    views: int = 2
    """Views of every model."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of masks."""
    neighbours: int = 40
    """Masks of neighbouring objects."""
    verbose: bool = False
    """Print every view."""


@dataclass(frozen=True)
class Case:
    """A view of a model: true alignment, and keypoints with noise."""

    annotated: AnnotatedModel
    scene: Scene
    camera: Camera
    truth: Alignment
    ids: list[int]
    points_2d: np.ndarray
    mask: np.ndarray

    @property
    def model(self) -> Model:
        """The model that is aligned."""
        return Model(points_3d=self.annotated.keypoints.xyz, mesh=self.scene.mesh)

    def view(self, mask: np.ndarray | None) -> View:
        """The keypoints, with or without a mask."""
        return View(self.camera, self.points_2d, ids=self.ids, sigma=NOISE_PX, mask=mask)


def main(arguments: MasksArguments) -> None:
    """Measure, print and write."""
    with tempfile.TemporaryDirectory() as folder:
        sample = KeypointNet(write_sample_dataset(Path(folder) / "sample", per_category=1))
        models = [model for model in sample if model.mesh_path is not None]
        if arguments.keypointnet is not None:
            models.extend(m for m in KeypointNet(arguments.keypointnet) if _has_obj(m))
        cases = list(draw_cases(models, arguments.views, arguments.seed))
    console = Console(width=220)
    results = {}
    table = new_table(f"masks, {len(cases)} views: medians", *COLUMNS)
    for kind in arguments.kinds:
        figures = measure(cases, kind, arguments)
        results[kind] = figures
        table.add_row(kind, *(f"{figures[name]:.3g}" for name in COLUMNS[1:]))
    console.print(table)
    if arguments.neighbours:
        results["neighbours"] = neighbours(cases, arguments)
        console.print(results["neighbours"])
    write_results(arguments.out, results)


COLUMNS = (
    "mask",
    "R_keypoints",
    "R",
    "ratio",
    "R_bound",
    "stretch_keypoints",
    "stretch",
    "stretch_bound",
    "iou_keypoints",
    "iou",
    "iou_bound",
    "iou_bottles",
    "sigma",
    "left_out",
    "seconds",
)


def _has_obj(model: AnnotatedModel) -> bool:
    return model.mesh_path is not None and model.mesh_path.suffix == ".obj"


def draw_cases(models: list[AnnotatedModel], views: int, seed: int) -> Iterator[Case]:
    """Random views of all models."""
    for number, model in enumerate(models):
        scene = Scene(model.load_mesh())
        rng = np.random.default_rng([seed, number])
        for _ in range(views):
            scale = np.array([1.0, *np.exp(rng.uniform(-1, 1, 2) * np.log(STRETCH))])
            for least in (7, LEAST_KEYPOINTS):
                try:
                    view = sample_view(
                        scene,
                        model.keypoints.xyz,
                        CAMERA,
                        rng=rng,
                        min_visible=least,
                        scale=scale,
                        fill=(0.6, 0.9),
                        roll=10.0,
                    )
                except RenderError:
                    continue
                yield case_of(model, scene, CAMERA, view.cam_from_model, view.visible, rng)
                break


def case_of(
    model: AnnotatedModel,
    scene: Scene,
    camera: Camera,
    truth: Alignment,
    visible: np.ndarray,
    rng: np.random.Generator,
) -> Case:
    """A view with noisy keypoints and the exact mask."""
    ids = np.flatnonzero(visible).tolist()
    pixels = camera.project(truth.apply(model.keypoints.xyz[ids]))
    noisy = pixels + rng.normal(0, NOISE_PX, pixels.shape)
    mask = cast_geometry(scene, camera, truth).mask
    return Case(model, scene, camera, truth, ids, noisy, mask)


def cut_by_border(case: Case, rng: np.random.Generator) -> Case:
    """The view with a quarter of the object outside the image; enough keypoints stay inside."""
    columns = np.cumsum(case.mask.sum(axis=0)) / case.mask.sum()
    shift = float(np.searchsorted(columns, 0.25))
    camera = replace(case.camera, cx=case.camera.cx - shift)
    inside = camera.contains(case.points_2d - [shift, 0.0])
    if inside.sum() < LEAST_KEYPOINTS:
        inside[:] = True
    visible = np.zeros(len(case.annotated.keypoints.xyz), dtype=bool)
    visible[np.array(case.ids)[inside]] = True
    return case_of(case.annotated, case.scene, camera, case.truth, visible, rng)


def errors(est: Alignment, case: Case) -> list[float]:
    """Rotation [deg], larger stretch error [%], box IoU."""
    gt = case.truth
    iou = alignment_box_iou(est=est, gt=gt, bounds=case.scene.bounds)
    stretch = 100 * float(np.abs(est.scale / gt.scale - 1)[1:].max())
    return [rotation_error(est=est, gt=gt), stretch, iou]


def measure(cases: list[Case], kind: str, arguments: MasksArguments) -> dict[str, float]:
    """Medians over all views for one kind of mask."""
    alone, joint, bounds, seconds, sigmas, left_out, bottles = [], [], [], [], [], 0, []
    for number, each in enumerate(cases):
        rng = np.random.default_rng([arguments.seed, 1, number])
        case = cut_by_border(each, rng) if kind == "border" else each
        mask = case.mask if kind == "border" else damaged_mask(case.mask, kind, rng)
        model = case.model
        try:
            without = align(model, case.view(None))
            start = time.perf_counter()
            result = align(model, case.view(mask))
        except CadalignError as error:
            print(kind, case.annotated.model_id, error)
            continue
        seconds.append(time.perf_counter() - start)
        alone.append(errors(without.alignment, case))
        joint.append(errors(result.alignment, case))
        bottles.append(case.annotated.category.endswith("bottle"))
        (residuals,) = result.mask_residuals
        assert residuals is not None
        left_out += not residuals.is_used
        sigmas.append(residuals.sigma)
        bound = contour_bound(model, case.view(mask), case.truth)
        bounds.append(ideal(bound, case, rng))
        if arguments.verbose:
            a, b = alone[-1], joint[-1]
            print(
                f"{kind} {case.annotated.category} {len(case.ids)} keypoints: R {a[0]:.2f} -> "
                f"{b[0]:.3f} ({np.median(bounds[-1][0]):.3f}), stretch {a[1]:.2f} -> {b[1]:.2f} "
                f"({np.median(bounds[-1][1]):.2f}), IoU {a[2]:.3f} -> {b[2]:.4f}, sigma "
                f"{residuals.sigma:.2f}, {residuals.correlation:.1f} alike, offset "
                f"{residuals.offset:.2f}, support {residuals.support:.2f}, {seconds[-1]:.2f} s",
                *(text for text in result.warnings if "mask" in text),
                flush=True,
            )
    rotation_alone, stretch_alone, iou_alone = np.median(alone, axis=0)
    rotation, stretch, iou = np.median(joint, axis=0)
    draws = np.concatenate(bounds, axis=1)
    of_bottles = np.array(joint)[bottles, 2]
    return {
        "R_keypoints": float(rotation_alone),
        "R": float(rotation),
        "ratio": float(rotation / rotation_alone),
        "R_bound": float(np.median(draws[0])),
        "stretch_keypoints": float(stretch_alone),
        "stretch": float(stretch),
        "stretch_bound": float(np.median(draws[1])),
        "iou_keypoints": float(iou_alone),
        "iou": float(iou),
        "iou_bound": float(np.median(draws[2])),
        "iou_bottles": float(np.median(of_bottles)) if len(of_bottles) else float("nan"),
        "sigma": float(np.nanmedian(sigmas)),
        "left_out": float(left_out),
        "seconds": float(np.median(seconds)),
    }


def ideal(bound: np.ndarray, case: Case, rng: np.random.Generator) -> np.ndarray:
    """Errors as of `errors` of an ideal estimator, (3, draws)."""
    drawn = rng.multivariate_normal(np.zeros(9), bound, size=BOUND_DRAWS, method="eigh")
    found = []
    for turn, shift, logs in zip(drawn[:, :3], drawn[:, 3:6], drawn[:, 6:], strict=True):
        rotation = rotation_from_vector(turn) @ case.truth.rotation
        scale = case.truth.scale * np.exp(logs)
        estimate = Alignment(rotation, case.truth.translation + shift, scale)
        found.append(errors(estimate, case))
    return np.array(found).T


def neighbours(cases: list[Case], arguments: MasksArguments) -> dict[str, float]:
    """Rate at which the mask of a neighbouring object is named, and its effect on the estimate."""
    named, ratios = [], []
    for number in range(arguments.neighbours):
        rng = np.random.default_rng([arguments.seed, 2, number])
        case, other = cases[number % len(cases)], cases[int(rng.integers(len(cases)))]
        mask = beside(other.mask, case.mask, rng)
        if mask is None:
            continue
        alone = errors(align(case.model, case.view(None)).alignment, case)
        result = align(case.model, case.view(mask))
        named.append(any("views[0].mask" in text for text in result.warnings))
        ratios.append(errors(result.alignment, case)[0] / alone[0])
        if arguments.verbose:
            print(case.annotated.category, other.annotated.category, named[-1], f"{ratios[-1]:.2f}")
    return {
        "named": float(np.mean(named)),
        "ratio": float(np.median(ratios)),
        "largest_ratio": float(np.max(ratios)),
        "count": len(named),
    }


def beside(other: np.ndarray, own: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Another object's mask moved beside the own one; None where too little of it is seen."""
    angle = rng.uniform(0, 2 * np.pi)
    rows, columns = np.nonzero(own)
    width, height = np.ptp(columns), np.ptp(rows)
    step = rng.uniform(0.5, 1.0) * np.array([np.cos(angle) * width, np.sin(angle) * height])
    moved = cv2.warpAffine(
        other.astype(np.uint8), np.array([[1, 0, step[0]], [0, 1, step[1]]]), own.shape[::-1]
    )
    return moved > 0 if moved.sum() > 0.2 * other.sum() else None


if __name__ == "__main__":
    main(tyro.cli(MasksArguments))
