"""Errors of methods on real images with known poses, stretched scenes and outliers.

As in the AEPnP paper, the scene is stretched by scales that are drawn anew for every draw, and a
share of the image points is moved to anywhere in the image. All methods get the same input. The
result columns are those of docs/formats/runs.md, as in all settings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import Correspondences, CorrespondenceSet
from cadalign.errors import DataError
from cadalign.estimation.options import RansacOptions
from cadalign.estimation.result import Result
from cadalign.evaluation.benchmark import Benchmark, Case, Setting, Tasks
from cadalign.evaluation.experiments.correspondences import COLUMNS, CorrespondenceOptions
from cadalign.evaluation.methods import Method, MethodInput
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.runs.work import Row, fingerprint_of_files
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class CorrespondenceTask:
    """One draw of scales for one image, with a share of its points to be moved.

    ``seen`` is None where the image cannot be read, for the reason ``problem``.
    """

    image: str
    outliers: float
    draw: int
    seen: Correspondences | None
    problem: str = ""

    @property
    def names(self) -> Row:
        """The cells that name its rows, but for the method."""
        return {"image": self.image, "draw": self.draw, "outliers": self.outliers}


class CorrespondenceTasks(Tasks[CorrespondenceTask]):
    """All draws, image by image and share by share."""

    def __init__(self, images: CorrespondenceSet, options: CorrespondenceOptions) -> None:
        self._source, self._outliers = Path(images.root), options.outliers
        self._draws = options.draws
        self._ids = images.names[: options.max_images]
        if not self._ids:
            raise DataError("there are no images", where=str(images.root))
        for _ in images:  # finds what cannot be read
            pass
        found = images.problems
        self._problems = {name: found[name] for name in self._ids if name in found}
        if len(self._problems) == len(self._ids):
            first = self._problems[self._ids[0]]
            raise DataError(
                f"none of {len(self._ids)} images can be read; the first: {first}",
                where=str(images.root),
            )
        self._read = lru_cache(maxsize=2)(images.__getitem__)

    def __len__(self) -> int:
        return len(self._ids) * len(self._outliers) * self._draws

    def task(self, index: int) -> CorrespondenceTask:
        """A draw for an image and a share."""
        rest, draw = divmod(index, self._draws)
        place, share = divmod(rest, len(self._outliers))
        name = self._ids[place]
        problem = self._problems.get(name)
        return CorrespondenceTask(
            image=name,
            outliers=self._outliers[share],
            draw=draw,
            seen=self._read(name) if problem is None else None,
            problem="" if problem is None else str(problem),
        )

    def fingerprint(self) -> str:
        """Hash of the files: a run must not go on with other data."""
        folder = self._source if self._source.is_dir() else self._source.parent
        return fingerprint_of_files(sorted(path for path in folder.iterdir() if path.is_file()))


SUCCESS_DEG = 0.5
"""A success has less than this rotation error [degrees] ..."""
SUCCESS_SCALE = 0.01
"""... and at most this relative error of either scale."""
_STRETCH = (0.5, 2.0)
_REDRAWS = 100


SpoiledImage = tuple[SimulatedProblem, RansacOptions]
"""An image with a stretched scene and moved points, and the options of searches for inliers."""


@dataclass(frozen=True)
class SpoiledImages(Setting):
    """Stretched scenes with outliers: the setting of the experiment on real correspondences."""

    columns = COLUMNS

    options: CorrespondenceOptions

    def failed(self, task: CorrespondenceTask) -> list[Case]:
        points = None if task.seen is None else len(task.seen)
        return [Case(task.names, {"points": points, "success": False})]

    def case(self, task: CorrespondenceTask) -> Case:
        if task.seen is None:
            raise DataError(task.problem)
        (case,) = self.failed(task)
        names = (task.image, str(task.draw), repr(task.outliers))
        rng = instance_rng(self.options.seed, *names)
        truth = spoil(task.seen, task.outliers, rng=rng)
        ransac = self.options.ransac(int(rng.integers(2**31)))
        return replace(case, instance=(truth, ransac))

    def given(self, image: SpoiledImage) -> MethodInput:
        truth, ransac = image
        given = (truth.points_3d, truth.points_2d, truth.camera)
        return MethodInput(*given, 1.0, ransac=ransac, gt=truth.alignment)

    def row(self, method: Method, image: SpoiledImage, estimate: Alignment | Result) -> Row:
        return errors_of(estimate, image[0], is_robust=method.is_robust)


def correspondence_benchmark(options: CorrespondenceOptions) -> Benchmark:
    """The methods of the options on spoiled images."""
    return Benchmark.chosen(SpoiledImages(options), options.methods, metrics=options.metrics)


def errors_of(
    found: Alignment | Result, truth: SimulatedProblem, *, is_robust: bool = False
) -> Row:
    """Errors of an estimate by column; of its inliers where they were searched for."""
    est = found if isinstance(found, Alignment) else found.alignment
    distance = np.linalg.norm(truth.alignment.apply(truth.points_3d).mean(axis=0))
    errors = alignment_errors(est=est, gt=truth.alignment, length=float(distance))
    scales = max(errors["scale_y_error"], errors["scale_z_error"])
    row: Row = {
        "points": len(truth.points_3d),
        **errors,
        "success": errors["rotation_error_deg"] < SUCCESS_DEG and scales <= SUCCESS_SCALE,
    }
    if not is_robust or isinstance(found, Alignment):
        return row
    inliers = np.ones(len(truth.points_3d), bool) if truth.outliers is None else ~truth.outliers
    kept, kept_inliers = int(found.inliers.sum()), int((found.inliers & inliers).sum())
    return {
        **row,
        "inliers": kept,
        "inlier_precision": kept_inliers / max(kept, 1),
        "inlier_recall": kept_inliers / max(int(inliers.sum()), 1),
    }


def spoil(seen: Correspondences, outliers: float, *, rng: np.random.Generator) -> SimulatedProblem:
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
    return SimulatedProblem(
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
        _, valid = camera.rays_where_valid(pixels)
        if valid.all():
            return pixels
        pixels[~valid] = rng.uniform(-0.5, size - 0.5, (int((~valid).sum()), 2))
    raise DataError("the lens model is valid in a small part of the image only", where="camera")
