"""Measure fits with a model that is only similar: which prior on the stretch helps.

Models of KeypointNet are seen with all keypoints and aligned with another model of their category,
drawn at random: `fit` with the noise estimated from the residuals, as `cadalign fit --similar`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from common import new_table
from rich.console import Console

from cadalign.arrays import FloatArray
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import CadalignError
from cadalign.estimation.fit import fit
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.metrics import box_iou, rotation_error
from cadalign.render.views.viewpoints import look_at
from cadalign.seeding import instance_rng

LEAST_KEYPOINTS = 6


@dataclass
class SimilarPriorArguments:
    """Measure which prior on the stretch helps with a model that is only similar."""

    root: tyro.conf.Positional[Path]
    """Folder in KeypointNet's layout."""
    sigmas: tuple[float, ...] = (np.inf, 0.5, 0.3, 0.2, 0.1)
    """Standard deviations of the logarithm of the stretch; inf for no prior."""
    objects: int = 150
    """Objects of each category."""
    noise_px: float = 2.0
    """Noise of the keypoints [px]."""


@dataclass(frozen=True, eq=False)
class SimilarProblem:
    """Keypoints (n, 3) of a model, those of the object, their image (n, 2), and the true pose."""

    model: FloatArray
    object: FloatArray
    points_2d: FloatArray
    truth: Alignment


def problem_of(
    seen: AnnotatedModel, others: Sequence[AnnotatedModel], noise: float
) -> SimilarProblem:
    """A random view of an object, and a random other model."""
    rng = instance_rng(0, seen.category, seen.model_id, "similar")
    other = others[int(rng.integers(len(others)))]
    own = {int(label): xyz for label, xyz in zip(*_keypoints(seen), strict=True)}
    pairs = [(own[int(k)], xyz) for k, xyz in zip(*_keypoints(other), strict=True) if k in own]
    points, model = (np.array(each).reshape(-1, 3) for each in zip(*pairs, strict=True))
    pose = look_at(
        azimuth=rng.uniform(0, 360), elevation=rng.uniform(0, 60), distance=rng.uniform(1.5, 3)
    )
    pixels = KEYPOINT_CAMERA.project(pose.apply(points))
    return SimilarProblem(model, points, pixels + noise * rng.standard_normal(pixels.shape), pose)


def errors(problem: SimilarProblem, sigma: float) -> tuple[float, float]:
    """Rotation error [degrees] and IoU of the keypoints' boxes at equal depths of their centres."""
    try:
        est = fit(
            problem.model,
            problem.points_2d,
            KEYPOINT_CAMERA,
            sigma=None,
            scale_prior_sigma=None if np.isinf(sigma) else sigma,
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


def main(arguments: SimilarPriorArguments) -> None:
    """Print the median errors of every category and prior."""
    names = ["none" if np.isinf(sigma) else f"{sigma:g}" for sigma in arguments.sigmas]
    table = new_table("Median rotation error in degrees / box IoU, by prior", "category", *names)
    dataset = KeypointNet(arguments.root)
    for category in dataset.categories:
        models = dataset[category]
        usable = [each for each in models if len(each.keypoints.xyz) >= LEAST_KEYPOINTS]
        problems = [
            problem_of(each, [other for other in usable if other is not each], arguments.noise_px)
            for each in usable[:: max(1, len(usable) // arguments.objects)]
        ]
        problems = [each for each in problems if len(each.model) >= LEAST_KEYPOINTS]
        cells = [
            np.nanmedian([errors(each, sigma) for each in problems], axis=0)
            for sigma in arguments.sigmas
        ]
        label = f"{category} ({len(problems)})"
        table.add_row(label, *(f"{angle:.1f} / {iou:.2f}" for angle, iou in cells))
    Console(width=100).print(table)


def _keypoints(model: AnnotatedModel) -> tuple[FloatArray, FloatArray]:
    return np.asarray(model.keypoints.semantic_ids), model.keypoints.xyz


if __name__ == "__main__":
    main(tyro.cli(SimilarPriorArguments))
