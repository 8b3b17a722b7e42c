"""Experiment on real correspondences: images with known poses, stretched scenes, outliers.

As in the AEPnP paper, each draw stretches the scene by random scales and moves a share of the image
points to random pixels. All methods get the same input.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import lru_cache, partial
from itertools import product, starmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import tyro

from cadalign.arrays import FloatArray, instance_rng
from cadalign.datasets import Correspondences, open_correspondences
from cadalign.errors import DataError, InputError
from cadalign.estimation.options import RansacOptions
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import Benchmark, Case, Setting
from cadalign.evaluation.methods import LIMIT, Method, MethodInput, pose_of
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.options import FunctionOptions
from cadalign.evaluation.plots import Plot, plot_against
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import OK, Columns, Plan, Row, fingerprint_of_files
from cadalign.evaluation.simulation import SimulatedProblem
from cadalign.evaluation.summary import (
    Group,
    Summary,
    group_name,
    milliseconds,
    share,
    summarize,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run


_SEARCH = RansacOptions(max_reproj_error=4.0, max_iterations=10_000)


@dataclass(frozen=True)
class CorrespondenceOptions(FunctionOptions):
    """Evaluate methods on real correspondences with outliers.

    For every image, share of outliers and draw, the scene is stretched by random factors from 0.5
    to 2 along y and z. That share of the image points is moved to random pixels. All methods get
    the same input. The run's folder gets results.parquet with a row per input and method,
    summary.csv, figures and report.html. An interrupted run continues when the same command is
    started again. Measure times with --workers 1.
    """

    experiment = "correspondences"

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of a COLMAP model, or of a split of a blind-PnP data set."""
    _: KW_ONLY
    outliers: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    """Shares of outliers among the image points, at least 0 and below 1."""
    draws: int = 20
    """Number of draws of scales and outliers per image and share."""
    methods: tuple[str, ...] = (
        "epnp",
        "aepnp-paper",
        "ransac-aepnp",
        "ransac-aepnp-refined",
        "ransac-optimal",
    )
    """Methods of `cadalign fit`; optimal-huber, optimal-cauchy (robust losses); ransac-optimal,
    ransac-ap4p (RANSAC); ransac-aepnp, ransac-aepnp-refined (the paper's RANSAC). Methods without
    RANSAC get all points, outliers included."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_methods()
        if LIMIT in self.methods:
            raise InputError(
                "the Cramer-Rao bound needs the noise of the image points, unknown for real images",
                where="methods",
                fix=f"leave {LIMIT!r} out",
            )
        shares = tuple(sorted({float(share) for share in self.outliers}))
        self.replace_values(outliers=shares)
        if not shares:
            raise InputError("none is given", where="outliers", fix="give shares such as 0 0.5")
        for each in shares:
            if not 0 <= each < 1:
                raise InputError(
                    f"{each:g} is not a share of outliers",
                    where="outliers",
                    fix="give numbers of at least 0 and below 1",
                )
        self.check_least(draws=1)


NAMES: Columns = (("image", str), ("draw", int), ("outliers", float), ("method", str))
COLUMNS: Columns = (
    *NAMES,
    *(("status", str), ("reason", str), ("points", int)),
    *(("rotation_error_deg", float), ("translation_error", float)),
    *(("scale_y_error", float), ("scale_z_error", float), ("success", bool)),
)
"""Columns of the result table; see docs/formats/runs.md."""
ERRORS = (metrics.ROTATION, metrics.TRANSLATION_OF_DISTANCE, metrics.SCALE_Y, metrics.SCALE_Z)


class CorrespondenceTask(NamedTuple):
    """One draw of scales and outliers for one image."""

    image: str
    outliers: float
    draw: int

    @property
    def names(self) -> Row:
        """The cells that identify its rows, without the method."""
        return {"image": self.image, "draw": self.draw, "outliers": self.outliers}


_images_of = lru_cache(maxsize=1)(open_correspondences)
"""The images of a folder, read once per process."""


_SUCCESS_DEG, _SUCCESS_SCALE = 0.5, 0.01  # upper bounds of rotation and relative scale errors
_STRETCH = (0.5, 2.0)
_REDRAWS = 100


@dataclass(frozen=True)
class ImageProblems(Setting):
    """Instances of the experiment: stretched scenes with outliers."""

    columns = COLUMNS

    options: CorrespondenceOptions

    def failed_case(self, task: CorrespondenceTask) -> Case:
        return Case(task.names, {"success": False})

    def case(self, task: CorrespondenceTask) -> Case:
        seen = _images_of(self.options.path)[task.image]
        names = (task.image, str(task.draw), repr(task.outliers))
        rng = instance_rng(self.options.seed, *names)
        truth = make_problem(seen, task.outliers, rng=rng)
        ransac = replace(_SEARCH, seed=int(rng.integers(2**31)))
        facts = {"points": len(seen), "success": False}
        return Case(task.names, facts, MethodInput.from_problem(truth, 1.0, ransac=ransac))

    def row(self, method: Method, given: MethodInput, estimate: Alignment | Result) -> Row:
        return errors_of(estimate, given)


def errors_of(found: Alignment | Result, given: MethodInput) -> Row:
    """Errors of an estimate, by column."""
    assert given.gt is not None
    distance = np.linalg.norm(given.gt.apply(given.points_3d).mean(axis=0))
    errors = alignment_errors(est=pose_of(found), gt=given.gt, length=float(distance))
    scales = max(errors["scale_y_error"], errors["scale_z_error"])
    is_success = errors["rotation_error_deg"] < _SUCCESS_DEG and scales <= _SUCCESS_SCALE
    return {"points": len(given.points_3d), **errors, "success": is_success}


def make_problem(
    seen: Correspondences, outliers: float, *, rng: np.random.Generator
) -> SimulatedProblem:
    """Stretch the scene of an image and move a share of its points to random pixels.

    The model is the scene with y and z divided by scales s_y and s_z in [0.5, 2]. The true
    alignment has the scene's pose and the scale (1, s_y, s_z). Raises DataError if the lens model
    is invalid in a large part of the image.
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
    """Random pixels (count, 2), uniform where the lens model can be inverted."""
    size = np.array([camera.width, camera.height])
    pixels = rng.uniform(-0.5, size - 0.5, (count, 2))
    for _ in range(_REDRAWS):
        _, valid = camera.rays_where_valid(pixels)
        if valid.all():
            return pixels
        pixels[~valid] = rng.uniform(-0.5, size - 0.5, (int((~valid).sum()), 2))
    raise DataError("the lens model is valid only in a small part of the image", where="camera")


# Summary ------------------------------------------------------------------------------------------

_COUNTS = (metrics.INSTANCES, metrics.FAILED)
HEADLINE = (*_COUNTS, metrics.SUCCESS, *ERRORS, metrics.QUERY_MILLISECONDS)


def _median(key: str) -> Callable[[Group], float]:
    """Median of an error over all inputs, where a failure is infinite; NaN if infinite.

    It does not improve when a method refuses hard inputs.
    """

    def made(group: Group) -> float:
        errors = np.where(group.rows["status"] == OK, group.rows[key].astype(float), np.inf)
        found = np.percentile(errors, 50, method="inverted_cdf") if len(errors) else np.nan
        return float(found) if np.isfinite(found) else np.nan

    return made


_STATISTICS = {
    "success": share(lambda solved: solved["success"].astype(bool)),
    **{metric.key: _median(metric.key) for metric in ERRORS},
    "milliseconds": milliseconds,
}


def summarize_shares(run: Run) -> list[Summary]:
    """One summary per share of outliers and method."""
    name = partial(group_name, metrics.OUTLIERS)
    return summarize(run, _STATISTICS, by=("outliers",), name=name)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Plots of success, errors and times against the share of outliers."""
    found = [summarize_shares(run) for run in runs]
    notes = {
        metrics.SUCCESS: "rotation error below 0.5 deg, both scale errors at most 1 %",
        **dict.fromkeys(ERRORS, "medians; failures count as infinite"),
        metrics.QUERY_MILLISECONDS: "medians",
    }
    return [
        plot_against(found, metrics.OUTLIERS, metric, note=note) for metric, note in notes.items()
    ]


def plan(options: CorrespondenceOptions, folder: RunFolder) -> Plan[CorrespondenceTask]:
    """Plan a run over all draws of all images of a model or data set."""
    _images_of.cache_clear()  # the files may have changed in this session
    images = _images_of(options.path)
    if not images.names:
        raise DataError("there are no images", where=str(images.root))
    every = product(images.names, options.outliers, range(options.draws))
    tasks = list(starmap(CorrespondenceTask, every))
    root = Path(images.root)
    files = sorted(filter(Path.is_file, (root if root.is_dir() else root.parent).iterdir()))
    benchmark = Benchmark.from_methods(
        ImageProblems(options), options.methods, metrics=options.metrics
    )
    return benchmark.plan(
        options,
        tasks,
        loader=type(images).__name__,
        correspondences=fingerprint_of_files(files),
    )


SPEC = Spec(
    options=CorrespondenceOptions,
    plan=plan,
    columns=HEADLINE,
    results=COLUMNS,
    summarize=summarize_shares,
    group=lambda run: metrics.OUTLIERS,
    plots=plots,
    topic="correspondences",
    subject="draws of real correspondences",
    note=(
        "Medians; a failure counts as an infinite error. Success: rotation error below 0.5 deg and "
        "both scale errors at most 1 %."
    ),
)
