"""The experiment on real correspondences: images with a share of their points moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from cadalign.datasets import open_correspondences
from cadalign.errors import InputError
from cadalign.estimation.options import RansacOptions
from cadalign.evaluation import metrics
from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.options import FunctionOptions
from cadalign.evaluation.plots import QUARTILES_NOTE, Plot, plot_against
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import OK, Columns, Plan
from cadalign.evaluation.summary import (
    Group,
    Quartiles,
    Summary,
    group_name,
    median,
    share,
    summarize,
    where,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.correspondences import CorrespondenceTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run


@dataclass(frozen=True)
class CorrespondenceOptions(FunctionOptions):
    """Evaluate methods on real correspondences with outliers.

    For every image, share of outliers and draw, the scene is stretched by factors from 0.5 to 2
    along y and z, and the share of the image points is moved to anywhere in the image; all methods
    get the same input. The run's folder gets results.parquet with a row per input and method,
    summary.csv, figures and report.html. A killed run continues when the same command is
    started again. Times are best measured with --workers 1.
    """

    experiment = "correspondences"

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of a COLMAP model, or of a blind-PnP data set's split."""
    _: KW_ONLY
    format: Literal["auto", "colmap", "blind-pnp"] = "auto"
    """Format of the folder; auto goes by the names of the files."""
    outliers: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    """Shares of the image points that are moved, from 0 to less than 1."""
    draws: int = 20
    """Number of draws of scales and outliers for every image and share."""
    methods: tuple[str, ...] = (
        "epnp",
        "aepnp-paper",
        "ransac-aepnp",
        "ransac-aepnp-refined",
        "ransac-optimal",
    )
    """Methods of `cadalign fit`, optimal-huber, optimal-cauchy, and those that search for inliers:
    ransac-optimal, ransac-ap4p, and the paper's two steps, ransac-aepnp and ransac-aepnp-refined.
    The others get all points."""
    max_reproj_error: float = 4.0
    """Largest reprojection error of an inlier, in pixels."""
    max_iterations: int = 10_000
    """Bound on the samples of a search for inliers."""
    max_images: int | None = None
    """Largest number of images, the first ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_methods()
        if LIMIT in self.methods:
            raise InputError(
                "the Cramer-Rao bound needs the noise of the image points, unknown in real images",
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
                    fix="give numbers from 0 to less than 1",
                )
        self.check_least(draws=1, max_images=1)
        self.ransac(0)

    def ransac(self, seed: int) -> RansacOptions:
        """The options of a search for inliers; the minimal solver is the method's."""
        return RansacOptions(
            max_reproj_error=self.max_reproj_error, max_iterations=self.max_iterations, seed=seed
        )


NAMES: Columns = (("image", str), ("draw", int), ("outliers", float), ("method", str))
COLUMNS: Columns = (
    *NAMES,
    *(("status", str), ("reason", str), ("points", int), ("inliers", int)),
    *(("rotation_error_deg", float), ("translation_error", float)),
    *(("scale_y_error", float), ("scale_z_error", float), ("success", bool)),
    *(("inlier_precision", float), ("inlier_recall", float)),
)
"""Columns of the result table; see docs/formats/runs.md."""
ERRORS = (metrics.ROTATION, metrics.TRANSLATION_OF_DISTANCE, metrics.SCALE_Y, metrics.SCALE_Z)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.SUCCESS, *ERRORS),
    *(metrics.INLIER_RECALL, metrics.MILLISECONDS),
)


def _quartiles(key: str) -> Callable[[Group], Quartiles]:
    """Quartiles of an error, which failures have infinite."""

    def made(group: Group) -> Quartiles:
        errors = np.where(group.rows["status"] == OK, group.rows[key].astype(float), np.inf)
        return Quartiles.of(errors)

    return made


_STATISTICS = {
    "success": share(lambda solved: solved["success"].astype(bool)),
    **{metric.key: _quartiles(metric.key) for metric in ERRORS},
    **{key: median(key) for key in ("inlier_precision", "inlier_recall")},
    "milliseconds": lambda group: Quartiles.of(1e3 * group.rows["seconds"]),
}


def summarize_shares(run: Run) -> list[Summary]:
    """A summary for every share of outliers and method, of the images that can be read."""
    return summarize(
        run,
        _STATISTICS,
        by=("outliers",),
        name=partial(group_name, metrics.OUTLIERS),
        cells=where(run.cells, ~np.isnan(run.cells["points"].astype(float))),
    )


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Success, errors and times against the share of outliers."""
    found = [summarize_shares(run) for run in runs]
    notes = {
        metrics.SUCCESS: "rotation within 0.5 deg and both scales within 1 %",
        **dict.fromkeys(ERRORS, f"{QUARTILES_NOTE}; failures count as infinite"),
        metrics.MILLISECONDS: QUARTILES_NOTE,
    }
    return [
        plot_against(found, metrics.OUTLIERS, metric, place="outliers", note=note)
        for metric, note in notes.items()
    ]


_CHUNK = 8


def plan(options: CorrespondenceOptions, folder: RunFolder) -> Plan[CorrespondenceTask]:
    """Plan a run over the images of a model or data set."""
    from cadalign.evaluation.instances.correspondences import (
        CorrespondenceTasks,
        correspondence_benchmark,
    )

    images = open_correspondences(options.path, format=options.format)
    tasks = CorrespondenceTasks(images, options)
    more = {"loader": type(images).__name__, "correspondences": tasks.fingerprint()}
    return correspondence_benchmark(options).plan(options, tasks, chunk=_CHUNK, **more)


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
        "Medians; a failure counts as an error beyond all others. Success: rotation within 0.5 deg "
        "and both scales within 1 %."
    ),
)
