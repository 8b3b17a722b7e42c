"""The real-data experiment: images with known poses, stretched scenes, wrong correspondences.

As in the AEPnP paper, the scene is stretched by scales that are drawn anew for every draw, and a
share of the image points is moved to anywhere in the image. All methods get the same input.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, InputError
from cadalign.evaluation.accuracy.methods import LIMIT, check_methods, fit_with
from cadalign.evaluation.accuracy.outcome import FAILED
from cadalign.evaluation.correspondences.outcome import CorrespondenceOutcome
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.run import Progress, execute, workers_of
from cadalign.evaluation.runs.work import Columns, Result, reason_of
from cadalign.evaluation.simulation.problems import Problem, simulate_problem
from cadalign.fitting.options import RansacOptions
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.seeding import instance_rng

if TYPE_CHECKING:
    from cadalign.datasets import Correspondences, CorrespondenceSet

DEFAULT_METHODS = ("epnp", "aepnp-paper", "ransac-aepnp", "ransac-aepnp-refined", "ransac-optimal")
DEFAULT_OUTLIERS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
_STRETCH = (0.5, 2.0)
_REDRAWS = 100
# Part of a run's configuration: another size would cut a half-done run into other chunks.
_CHUNK = 8


@dataclass(frozen=True)
class CorrespondenceOptions:
    """How to evaluate on correspondences.

    Parameters
    ----------
    outliers : tuple of float
        Shares of the image points that are moved to anywhere in the image; kept sorted.
    draws : int
        How often scales and outliers are drawn for every image and share.
    methods : tuple of str
        Names of `method_names`, without the limit. Those that do not search for inliers get all
        points.
    max_reproj_error : float
        Largest reprojection error of an inlier [px].
    max_iterations : int
        Bound on the samples of a search for inliers.
    seed : int
    max_images : int, optional
        How many images at most, the first ones.

    Raises
    ------
    InputError
        If a value is out of range or a method unknown.
    """

    outliers: tuple[float, ...] = DEFAULT_OUTLIERS
    draws: int = 20
    methods: tuple[str, ...] = DEFAULT_METHODS
    max_reproj_error: float = 4.0
    max_iterations: int = 10_000
    seed: int = 0
    max_images: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "methods", check_methods(self.methods))
        if LIMIT in self.methods:
            raise InputError(
                "the limit needs the noise of the image points, which nobody knows of real images",
                where="methods",
                fix=f"leave {LIMIT!r} out",
            )
        shares = tuple(sorted({float(share) for share in self.outliers}))
        object.__setattr__(self, "outliers", shares)
        if not shares:
            raise InputError("none is given", where="outliers", fix="give shares such as 0 0.5")
        for share in shares:
            if not 0 <= share < 1:
                raise InputError(
                    f"{share:g} is not a share of wrong points",
                    where="outliers",
                    fix="give numbers from 0 to less than 1",
                )
        for name, least in (("draws", 1), ("seed", 0), ("max_images", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{value} is less than {least}", where=name)
        self.ransac(0)

    def ransac(self, seed: int) -> RansacOptions:
        """The options of a search for inliers; the minimal solver is the method's."""
        return RansacOptions(
            max_reproj_error=self.max_reproj_error, max_iterations=self.max_iterations, seed=seed
        )


@dataclass(frozen=True, eq=False)
class CorrespondenceTask:
    """One draw of scales and outliers for one image.

    Parameters
    ----------
    image : str
        Its id.
    outliers : float
        Share of the image points that are to be moved.
    draw : int
    seen : Correspondences, optional
        What the image shows; None where it cannot be read.
    problem : str
        Why it cannot be read.
    """

    image: str
    outliers: float
    draw: int
    seen: Correspondences | None
    problem: str = ""


class CorrespondenceTasks(Sequence[CorrespondenceTask]):
    """All draws, image by image and share by share, made when asked for.

    Parameters
    ----------
    images : CorrespondenceSet
    options : CorrespondenceOptions

    Raises
    ------
    DataError
        If no image can be read.
    """

    def __init__(self, images: CorrespondenceSet, options: CorrespondenceOptions) -> None:
        self._images = images
        self._outliers = options.outliers
        self._draws = options.draws
        self._ids = images.ids[: options.max_images]
        if not self._ids:
            raise DataError("there are no images", where=str(images.source))
        problems = images.problems
        self._problems = {name: problems[name] for name in self._ids if name in problems}
        if len(self._problems) == len(self._ids):
            first = self._problems[self._ids[0]]
            raise DataError(
                f"none of {len(self._ids)} images can be read; the first: {first}",
                where=str(images.source),
            )
        self._read = lru_cache(maxsize=2)(self._read_image)

    def __len__(self) -> int:
        return len(self._ids) * len(self._outliers) * self._draws

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        rest, draw = divmod(range(len(self))[index], self._draws)
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
        """A hash of all that is read: a run must not go on with other data."""
        digest = hashlib.sha256()
        for name in self._ids:
            digest.update(f"{name}\0".encode())
            if name in self._problems:
                digest.update(str(self._problems[name]).encode())
                continue
            seen = self._read(name)
            pose = seen.cam_from_world
            for values in (seen.points_3d, seen.points_2d, pose.rotation, pose.translation):
                digest.update(np.ascontiguousarray(values).tobytes())
            digest.update(repr(seen.camera).encode())
        return digest.hexdigest()[:16]

    def _read_image(self, name: str) -> Correspondences:
        return self._images[name]


@dataclass(frozen=True)
class CorrespondenceExperiment:
    """Evaluates methods on stretched scenes with wrong correspondences.

    Parameters
    ----------
    options : CorrespondenceOptions
        ``outliers``, ``draws`` and ``max_images`` are the tasks' business.
    """

    options: CorrespondenceOptions

    @property
    def columns(self) -> Columns:
        """The columns of the result table; see `CorrespondenceOutcome`."""
        return CorrespondenceOutcome.columns()

    @property
    def timing_columns(self) -> Columns:
        """The input, the method, and the seconds of its call."""
        names: Columns = (("image", str), ("draw", int), ("outliers", float), ("method", str))
        return (*names, ("seconds", float))

    def warm_up(self) -> None:
        """Compile the solvers."""
        from cadalign.datasets import Correspondences

        made = simulate_problem(
            np.random.default_rng(0), points=40, noise_px=0.5, stretch=(1.0, 1.0)
        )
        seen = Correspondences("", made.points_3d, made.points_2d, made.camera, made.alignment)
        self.evaluate([CorrespondenceTask("warm-up", 0.2, 0, seen)])

    def evaluate(self, tasks: Sequence[CorrespondenceTask]) -> Result:
        """A row for every task and method."""
        return Result.joined([self._evaluate_one(task) for task in tasks])

    def failure(self, task: CorrespondenceTask, reason: str) -> Result:
        """A failed row for every method."""
        points = None if task.seen is None else len(task.seen)
        rows = [
            asdict(
                CorrespondenceOutcome(
                    **_labels(task, method), status=FAILED, reason=reason, points=points
                )
            )
            for method in self.options.methods
        ]
        return Result(rows, [_timing(task, method, None) for method in self.options.methods])

    def _evaluate_one(self, task: CorrespondenceTask) -> Result:
        if task.seen is None:
            return self.failure(task, task.problem)
        names = (task.image, str(task.draw), repr(task.outliers))
        rng = instance_rng(self.options.seed, *names)
        truth = spoil(task.seen, task.outliers, rng=rng)
        ransac = self.options.ransac(int(rng.integers(2**31)))
        rows, timings = [], []
        for method in self.options.methods:
            labels = _labels(task, method)
            start = time.perf_counter()
            try:
                result = fit_with(
                    method, truth.points_3d, truth.points_2d, truth.camera, ransac=ransac
                )
                seconds = time.perf_counter() - start
                outcome = CorrespondenceOutcome.of_fit(result, truth, **labels)
            except Exception as error:
                seconds = time.perf_counter() - start
                outcome = CorrespondenceOutcome(
                    **labels, status=FAILED, reason=reason_of(error), points=len(task.seen)
                )
            rows.append(asdict(outcome))
            timings.append(_timing(task, method, seconds))
        return Result(rows, timings)


def spoil(seen: Correspondences, outliers: float, *, rng: np.random.Generator) -> Problem:
    """Stretch what an image shows, and move some of its points to anywhere in the image.

    Parameters
    ----------
    seen : Correspondences
    outliers : float
        Share of the points that are moved, rounded to a whole number of them.
    rng : numpy.random.Generator
        The only source of randomness.

    Returns
    -------
    Problem
        The model is the scene with y and z divided by scales between 0.5 and 2, so that the true
        alignment has the scene's true pose and the scale (1, s_y, s_z).

    Raises
    ------
    DataError
        If the lens model is not valid in nearly the whole image.
    """
    scale = np.array([1.0, *rng.uniform(*_STRETCH, 2)])
    pose = seen.cam_from_world
    count = round(outliers * len(seen))
    wrong = np.zeros(len(seen), dtype=bool)
    wrong[rng.choice(len(seen), size=count, replace=False)] = True
    points_2d = seen.points_2d.copy()
    points_2d[wrong] = _pixels_anywhere(seen.camera, count, rng)
    return Problem(
        points_3d=seen.points_3d / scale,
        points_2d=points_2d,
        camera=seen.camera,
        alignment=Alignment(pose.rotation, pose.translation, scale),
        outliers=wrong,
    )


def run_correspondences(
    path: str | os.PathLike[str],
    options: CorrespondenceOptions,
    folder: RunFolder,
    *,
    format: str = "auto",
    workers: int = -1,
    dask: str | None = None,
    on_progress: Callable[[Progress], object] = lambda progress: None,
) -> None:
    """Evaluate on correspondences in a run's folder, or what is left of it.

    Parameters
    ----------
    path : str or path-like
    options : CorrespondenceOptions
    folder : RunFolder
    format : str
        See `cadalign.datasets.open_correspondences`.
    workers, dask
        See `cadalign.evaluation.runs.run.workers_of`.
    on_progress : callable
        Told of every chunk.

    Raises
    ------
    InputError
        If the format is unknown.
    DataError
        If there are no correspondences, or the folder holds another run.
    """
    from cadalign.datasets import open_correspondences

    images = open_correspondences(path, format=format)
    tasks = CorrespondenceTasks(images, options)
    execute(
        CorrespondenceExperiment(options),
        tasks,
        folder,
        config={
            "experiment": "correspondences",
            "path": str(Path(path).absolute()),
            "loader": type(images).__name__,
            "correspondences": tasks.fingerprint(),
            **asdict(options),
        },
        chunk_size=_CHUNK,
        workers=workers_of(workers, dask=dask),
        on_progress=on_progress,
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


def _labels(task: CorrespondenceTask, method: str) -> dict[str, Any]:
    return {
        "image": task.image,
        "draw": task.draw,
        "outliers": task.outliers,
        "method": method,
    }


def _timing(task: CorrespondenceTask, method: str, seconds: float | None) -> dict[str, Any]:
    return {**_labels(task, method), "seconds": seconds}
