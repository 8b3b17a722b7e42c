"""The experiment on data sets of photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.metrics import BOX_IOU
from cadalign.evaluation.metrics.photos import (
    BOX,
    ROTATION,
    SCAN2CAD,
    VIEWPOINT,
    score_columns,
    statistics_of,
)
from cadalign.evaluation.photos.options import SETS, PhotosOptions
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import LEFT_OUT, UNREADABLE, Columns, Plan, fingerprint
from cadalign.evaluation.summary import (
    ALL,
    MEAN,
    Summary,
    mean,
    mean_of,
    median,
    milliseconds,
    summarize,
)
from cadalign.io.files import read_bytes

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int), ("source", str)),
    *(("rms_px", float), *score_columns(SETS)),
)
"""Columns of the result table; see docs/formats/runs.md."""


GALLERY = (
    *(metric for each in SETS for metric in each.medians),
    metrics.RMS,
)
"""Errors of single objects."""
# The data sets' own first.
_OWN_FIRST = (SCAN2CAD, VIEWPOINT, BOX)
_COUNTS = (metrics.INSTANCES, metrics.FAILED, metrics.LEFT_OUT)
HEADLINE = (
    *(*_COUNTS, metrics.KEYPOINTS),
    *(metric for each in _OWN_FIRST for metric in each.shown),
    *(metrics.RMS, metrics.QUERY_MILLISECONDS),
)
_CONSOLE = (
    *(*_COUNTS, *SCAN2CAD.shown[:1], *VIEWPOINT.shown, *BOX.shown[:2]),
    *(replace(metrics.RMS, symbol="rms px"), metrics.QUERY_MILLISECONDS),
)


def summarize_objects(run: Run) -> list[Summary]:
    """A summary for every category and method, for all together, and the mean of categories."""
    cells = run.cells
    statistics = {
        "keypoints": mean("keypoints"),
        **statistics_of(SETS, cells),
        metrics.RMS.key: median(metrics.RMS.key),
        "milliseconds": milliseconds,
    }
    found = summarize(run, statistics, apart=LEFT_OUT)
    single = [each for each in found if each.group not in (ALL, UNREADABLE)]
    if len({each.group for each in single}) < 2:
        return found
    whole = [each for each in found if each.group == ALL]
    return [*found, *(_mean(every, single) for every in whole)]


def _mean(every: Summary, single: Sequence[Summary]) -> Summary:
    """The mean of a method's values over categories; its counts are those of all."""
    own = [each for each in single if each.method == every.method]
    values = {
        key: value if isinstance(value, int) else mean_of(np.array([s.values[key] for s in own]))
        for key, value in every.values.items()
    }
    return Summary(MEAN, {"category": MEAN, "method": every.method}, values)


_CURVES = (
    (ROTATION, np.array([0.2, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 45, 90])),
    (replace(BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
)

plots = partial(cumulative_curves, curves=_CURVES, of="on photos")
"""Shares of objects within an error, as `Spec.plots`."""


_CHUNK, _LARGE_CHUNK = 4, 32
_LARGE = 500  # photos


def plan(options: PhotosOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan a run over the photos of a data set."""
    from cadalign.evaluation.photos.objects import photos_benchmark
    from cadalign.evaluation.photos.target import PhotoTasks, reopened
    from cadalign.evaluation.shape_files import shapes_of

    dataset = reopened(options.root)
    shapes = shapes_of(options.shape)
    tasks = PhotoTasks(dataset, options.max_photos)
    pictures = folder.made_for_pictures()
    chunk = _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    return photos_benchmark(options, shapes, pictures).plan(
        options,
        tasks,
        chunk=chunk,
        kind=dataset.kind,
        shapes=fingerprint(*map(read_bytes, options.shape)),
        annotations=tasks.fingerprint(),
    )


SPEC = Spec(
    options=PhotosOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize_objects,
    console=_CONSOLE,
    console_note="shares count failures",
    plots=plots,
    apart=LEFT_OUT,
    topic="alignment to photos",
    subject="photos",
    metrics=GALLERY,
    about=(
        "Green is the truth, red what a method found: its box, and the model warped to the "
        "estimated shape."
    ),
    note=(
        "Medians over the objects that did not fail, and shares of all, of which failures count as "
        "misses; objects without camera, model or enough keypoints are left out. The model's width "
        "is the object's, as one image leaves size open, where no shape model in metres "
        "determines it."
    ),
)
