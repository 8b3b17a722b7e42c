"""Errors of methods on real images with known poses, stretched scenes and outliers.

As in the AEPnP paper, the scene is stretched by scales that are drawn anew for every draw, and a
share of the image points is moved to anywhere in the image. All methods get the same input.

Columns of the result table, one row per input and method: what names the row (``image``, ``draw``,
``outliers``, the share of the image points that were moved, and ``method``), ``status`` and
``reason``, and then

points
    Number of points that the method was given; empty where the image could not be read.
inliers
    Number of points that it kept; empty for methods that do not search for inliers.
rotation_error_deg
    [degrees]
translation_error
    Over the distance from the camera to the mean of the image's points, a fraction.
scale_y_error, scale_z_error
    Relative errors, fractions.
success
    True if the rotation error is less than 0.5 degrees and neither scale is off by more than 1 %.
inlier_precision
    Share of the points that it kept that were not moved.
inlier_recall
    Share of the points that were not moved that it kept.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets import Correspondences
from cadalign.errors import DataError
from cadalign.estimation.fit import fit
from cadalign.estimation.result import Result
from cadalign.evaluation.accuracy.methods import fit_options, is_robust
from cadalign.evaluation.correspondences.options import CorrespondenceOptions
from cadalign.evaluation.correspondences.tasks import CorrespondenceTask
from cadalign.evaluation.outcome import Outcome, alignment_errors, reason_of
from cadalign.evaluation.runs.tables import Columns, Row
from cadalign.evaluation.runs.work import Rows
from cadalign.evaluation.simulation.problems import Problem, simulate_problem
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.seeding import instance_rng

SUCCESS_DEG = 0.5
"""A success has less than this rotation error [degrees] ..."""
SUCCESS_SCALE = 0.01
"""... and at most this relative error of either scale."""
_STRETCH = (0.5, 2.0)
_REDRAWS = 100
_NAMES: Columns = (("image", str), ("draw", int), ("outliers", float), ("method", str))
COLUMNS: Columns = (
    *_NAMES,
    *(("status", str), ("reason", str), ("points", int), ("inliers", int)),
    *(("rotation_error_deg", float), ("translation_error", float)),
    *(("scale_y_error", float), ("scale_z_error", float), ("success", bool)),
    *(("inlier_precision", float), ("inlier_recall", float)),
)


@dataclass(frozen=True)
class CorrespondenceExperiment:
    """Evaluates methods on stretched scenes with outliers."""

    columns = COLUMNS
    timing_columns = (*_NAMES, ("seconds", float))

    options: CorrespondenceOptions

    def warm_up(self) -> None:
        """Compile the solvers."""
        problem = simulate_problem(
            np.random.default_rng(0), points=40, noise_px=0.5, stretch=(1.0, 1.0)
        )
        seen = Correspondences(
            "", problem.points_3d, problem.points_2d, problem.camera, problem.alignment
        )
        self.evaluate([CorrespondenceTask("warm-up", 0.2, 0, seen)])

    def evaluate(self, tasks: Sequence[CorrespondenceTask]) -> Rows:
        """A row for every task and method."""
        return Rows.joined([self._evaluate_one(task) for task in tasks])

    def failure(self, task: CorrespondenceTask, reason: str) -> Rows:
        """A failed row for every method."""
        return Rows.of(_failure(task, method, reason) for method in self.options.methods)

    def _evaluate_one(self, task: CorrespondenceTask) -> Rows:
        if task.seen is None:
            return self.failure(task, task.problem)
        names = (task.image, str(task.draw), repr(task.outliers))
        rng = instance_rng(self.options.seed, *names)
        truth = spoil(task.seen, task.outliers, rng=rng)
        ransac = self.options.ransac(int(rng.integers(2**31)))
        outcomes = []
        for method in self.options.methods:
            start = time.perf_counter()
            try:
                how = fit_options(method, sigma=1.0, ransac=ransac)
                result = fit(truth.points_3d, truth.points_2d, truth.camera, **how)
                seconds = time.perf_counter() - start
                outcome = Outcome(task.names(method), errors_of(result, truth, method=method))
            except Exception as error:
                seconds = time.perf_counter() - start
                outcome = _failure(task, method, reason_of(error))
            outcomes.append(replace(outcome, seconds=seconds))
        return Rows.of(outcomes)


def errors_of(result: Result, truth: Problem, *, method: str) -> Row:
    """Errors of a fit by column."""
    distance = np.linalg.norm(truth.alignment.apply(truth.points_3d).mean(axis=0))
    errors = alignment_errors(est=result.alignment, gt=truth.alignment, length=float(distance))
    scales = max(errors["scale_y_error"], errors["scale_z_error"])
    found: Row = {
        "points": len(truth.points_3d),
        **errors,
        "success": errors["rotation_error_deg"] < SUCCESS_DEG and scales <= SUCCESS_SCALE,
    }
    if not is_robust(method):
        return found
    inliers = np.ones(len(truth.points_3d), bool) if truth.outliers is None else ~truth.outliers
    kept, kept_inliers = int(result.inliers.sum()), int((result.inliers & inliers).sum())
    return {
        **found,
        "inliers": kept,
        "inlier_precision": kept_inliers / max(kept, 1),
        "inlier_recall": kept_inliers / max(int(inliers.sum()), 1),
    }


def spoil(seen: Correspondences, outliers: float, *, rng: np.random.Generator) -> Problem:
    """Stretch what an image shows, and move a share of its points to anywhere in the image.

    The model is the scene with y and z divided by scales between 0.5 and 2, so that the true
    alignment has the scene's true pose and the scale (1, s_y, s_z). Raises DataError if the lens
    model is not valid in nearly the whole image.
    """
    scale = np.array([1.0, *rng.uniform(*_STRETCH, 2)])
    pose = seen.cam_from_world
    count = round(outliers * len(seen))
    moved = np.zeros(len(seen), dtype=bool)
    moved[rng.choice(len(seen), size=count, replace=False)] = True
    points_2d = seen.points_2d.copy()
    points_2d[moved] = _pixels_anywhere(seen.camera, count, rng)
    return Problem(
        points_3d=seen.points_3d / scale,
        points_2d=points_2d,
        camera=seen.camera,
        alignment=Alignment(pose.rotation, pose.translation, scale),
        outliers=moved,
    )


def _pixels_anywhere(camera: Camera, count: int, rng: np.random.Generator) -> FloatArray:
    """Uniform over that part of the image which the lens model can be inverted in, (count, 2)."""
    size = np.array([camera.width, camera.height])
    pixels = rng.uniform(-0.5, size - 0.5, (count, 2))
    for _ in range(_REDRAWS):
        _, valid = camera.normalize_where_valid(pixels)
        if valid.all():
            return pixels
        pixels[~valid] = rng.uniform(-0.5, size - 0.5, (int((~valid).sum()), 2))
    raise DataError("the lens model is valid in a small part of the image only", where="camera")


def _failure(task: CorrespondenceTask, method: str, reason: str) -> Outcome:
    points = None if task.seen is None else len(task.seen)
    return Outcome.failure(reason, task.names(method), points=points, success=False)
