"""The experiment on real correspondences: images with a share of their points moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from cadalign.datasets import open_correspondences
from cadalign.errors import InputError
from cadalign.estimation.options import RansacOptions
from cadalign.evaluation import metrics
from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.options import FunctionOptions
from cadalign.evaluation.plots import QUARTILES_NOTE, Plot, Trace
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import OK, Columns, Plan
from cadalign.evaluation.summary import (
    Conclusion,
    ConsoleTable,
    Quartiles,
    Summary,
    group_name,
    median_of,
    where,
    with_medians,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.correspondences import CorrespondenceTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Cells, Run


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
        for share in shares:
            if not 0 <= share < 1:
                raise InputError(
                    f"{share:g} is not a share of outliers",
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
SUCCESS_NOTE = "success: rotation within 0.5 deg and both scales within 1 %"


def summarize(run: Run) -> list[Summary]:
    """A summary for every share of outliers and method, in the order of the run."""
    cells = run.cells
    return [
        with_medians(
            _summarize(share, method, cells), where(cells, cells["outliers"] == share), run.metrics
        )
        for share in np.unique(cells["outliers"]).tolist()
        for method in run.methods
    ]


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """Quartiles of the errors, and medians, for the console."""
    failed = replace(metrics.FAILED, symbol="fail")
    shown = (failed, metrics.SUCCESS, *ERRORS, metrics.INLIER_RECALL)
    return ConsoleTable(
        title="Lower quartile, median and upper quartile per share of outliers and method",
        labels=(metrics.OUTLIERS.symbol, "method"),
        heads=tuple(each.symbol for each in (*shown, metrics.MILLISECONDS, *run.metrics)),
        rows=[
            (
                f"{100 * s['outliers']:g} %",
                s.method,
                failed.text(s["failed"]),
                metrics.SUCCESS.text(s["success"]),
                *(_three(s[metric.key], metric) for metric in ERRORS),
                _number(100 * s["inlier_recall"], digits=1),
                _number(s["milliseconds"].median, digits=1),
                *(metric.text(s[metric.key]) for metric in run.metrics),
            )
            for s in summaries
        ],
        note=(
            f"{max(s['inputs'] for s in summaries)} inputs each; a failure counts as an error "
            "beyond all others (-).\n"
            "succ: R < 0.5 deg and both scales within 1 %; t: % of the camera's distance from the "
            "mean of the points;\nfound: share of the inliers that were kept (median); ms: median."
        ),
        narrow=True,
    )


def conclude(run: Run, summaries: Sequence[Summary]) -> Conclusion:
    """Numbers of rows, of failures, and of inputs whose image cannot be read."""
    unreadable = sum(summary["unreadable"] for summary in summaries)
    rows = sum(summary["inputs"] for summary in summaries) + unreadable
    failed = sum(summary["failed"] for summary in summaries) + unreadable
    note = f"{unreadable} of them because their image cannot be read" if unreadable else ""
    return Conclusion(rows, failed, {"unreadable": unreadable}, note)


def plots(runs: Sequence[Run]) -> list[Plot]:
    """Success, errors and times against the share of outliers."""
    found = [summarize(run) for run in runs]
    inputs = max((summary["inputs"] for summary in found[0]), default=0)
    made = []
    for metric in (metrics.SUCCESS, *ERRORS, metrics.MILLISECONDS):
        note = f"{QUARTILES_NOTE}; failures count as infinite"
        if metric is metrics.MILLISECONDS:
            note = QUARTILES_NOTE
        elif metric is metrics.SUCCESS:
            note = ""
        traces = []
        for index, summaries in enumerate(found):
            for method in runs[index].methods:
                rows = [summary for summary in summaries if summary.method == method]
                x = [100 * summary["outliers"] for summary in rows]
                y = [summary[metric.key] for summary in rows]
                traces.append(Trace.of(index, method, x, y, metric))
        caption = f"{inputs} inputs each; {note or SUCCESS_NOTE}"
        figure = f"outliers_{metric.key}"
        made.append(Plot(metric.key, metrics.OUTLIERS, metric, traces, note, caption, figure))
    return made


def _summarize(share: float, method: str, cells: Cells) -> Summary:
    chosen = (cells["outliers"] == share) & (cells["method"] == method)
    # No points were given where the image cannot be read.
    given = chosen & ~np.isnan(cells["points"].astype(float))
    solved = given & (cells["status"] == OK)
    inputs = int(given.sum())
    quartiles = {}
    for metric in ERRORS:
        errors = np.full(inputs, np.inf)
        errors[solved[given]] = cells[metric.key][solved].astype(float)
        quartiles[metric.key] = Quartiles.of(errors)
    values = {
        "inputs": inputs,
        "failed": inputs - int(solved.sum()),
        "unreadable": int(chosen.sum()) - inputs,
        "success": float(cells["success"][given].astype(float).mean()) if inputs else np.nan,
        **quartiles,
        "inlier_precision": median_of(cells["inlier_precision"][solved]),
        "inlier_recall": median_of(cells["inlier_recall"][solved]),
        "milliseconds": Quartiles.of(1e3 * cells["seconds"][given]),
    }
    names = {"outliers": share, "method": method}
    return Summary(group_name(metrics.OUTLIERS, share), names, values, tasks=inputs)


def _three(values: Quartiles, metric: Metric) -> str:
    quartiles = (values.lower, values.median, values.upper)
    return " ".join(_number(metric.factor * value, digits=metric.digits) for value in quartiles)


def _number(value: float, *, digits: int) -> str:
    """A number with so many digits after the point, fewer for larger ones; a dash for NaN."""
    if value != value:
        return "-"
    if value >= 1e4:
        return f"{value:.0e}"
    places = max(0, digits + 1 - len(str(int(value))))
    return f"{value:.{places}f}"


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


def _describe(run: Run) -> str:
    images = run.count("image")
    return (
        f"on real correspondences in {images:,} image{'s' * (images != 1)} of {run.dataset}, with "
        "a share of them moved to anywhere in the image"
    )


SPEC = Spec(
    options=CorrespondenceOptions,
    plan=plan,
    columns=HEADLINE,
    results=COLUMNS,
    summarize=summarize,
    table=console_table,
    group=lambda run: metrics.OUTLIERS,
    plots=plots,
    conclude=conclude,
    topic="correspondences",
    describe=_describe,
    note=(
        "Medians; a failure counts as an error beyond all others. Success: rotation within 0.5 deg "
        "and both scales within 1 %."
    ),
)
