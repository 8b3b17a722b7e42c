"""The experiment on data sets of photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.errors import DataError
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.metrics import BOX_IOU
from cadalign.evaluation.metrics.photos import (
    NINE_DOF,
    ROTATION,
    VIEWPOINT,
    score_columns,
    statistics_of,
)
from cadalign.evaluation.metrics.scan2cad import SCAN2CAD
from cadalign.evaluation.photos import protocols
from cadalign.evaluation.photos.options import PhotosOptions
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
    from cadalign.evaluation.runs.tables import Cells, Run

COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int), ("source", str)),
    *(("rms_px", float), *score_columns(protocols.SETS)),
)
"""Columns of the result table; see docs/formats/runs.md."""


GALLERY = (
    *(metric for each in protocols.SETS for metric in each.medians),
    metrics.RMS,
)
"""Errors of single objects."""
# The data sets' own first.
_OWN_FIRST = (SCAN2CAD, VIEWPOINT, NINE_DOF)
HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.LEFT_OUT, metrics.KEYPOINTS),
    *(metric for each in _OWN_FIRST for metric in each.headline),
    *(metric for each in _OWN_FIRST for metric in each.details),
    *(metrics.RMS, metrics.QUERY_MILLISECONDS),
)
_CONSOLE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.LEFT_OUT),
    *(metric for each in _OWN_FIRST for metric in each.console),
    *(replace(metrics.RMS, symbol="rms px"), metrics.QUERY_MILLISECONDS),
)


def summarize_objects(run: Run) -> list[Summary]:
    """A summary for every category and method, for all together, and the mean of categories."""
    cells = run.cells
    statistics = {
        "keypoints": mean("keypoints"),
        **statistics_of(protocols.SETS, cells),
        metrics.RMS.key: median(metrics.RMS.key),
        "milliseconds": milliseconds,
    }
    marked = {**cells, "category": _categories(cells)}
    found = summarize(run, statistics, apart=LEFT_OUT, cells=marked)
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


def _categories(cells: Cells) -> npt.NDArray[np.object_]:
    """The rows' categories, those of objects with simulated keypoints marked."""
    categories, is_simulated = cells["category"], cells["source"] == protocols.SIMULATED
    known_otherwise = set(categories[(cells["status"] != LEFT_OUT) & ~is_simulated].tolist())
    only = set(categories[is_simulated].tolist()) - known_otherwise
    marked = is_simulated | np.isin(categories.astype(str), sorted(only))
    names = [
        f"{name}, {protocols.SIMULATED}" if mark else name
        for name, mark in zip(categories.tolist(), marked.tolist(), strict=True)
    ]
    return np.array(names, dtype=object)


_CURVES = (
    (ROTATION, np.array([0.2, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 45, 90])),
    (replace(BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
)

plots = partial(cumulative_curves, curves=_CURVES, of="on photos")
"""Shares of objects within an error, as `Spec.plots`."""


_CHUNK, _LARGE_CHUNK = 4, 32
_LARGE = 500  # photos
_LOOKED_AT = 20  # photos that say which evidence the data set has


def plan(options: PhotosOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan a run over the photos of a data set."""
    from cadalign.evaluation.photos.objects import photos_benchmark
    from cadalign.evaluation.photos.target import PhotoTasks, reopened
    from cadalign.evaluation.shape_files import shapes_of

    dataset = reopened(options.root)
    protocol = protocols.protocol_of(dataset.kind)
    shapes = shapes_of(options.shape)
    if not options.methods:
        methods = protocols.default_methods(
            with_evidence=tuple(dict.fromkeys((protocols.RIGID, protocol.best))),
            evidence=_evidence(dataset),
            has_shape=bool(shapes),
        )
        options = replace(options, methods=methods)
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


def _evidence(dataset: PhotoDataset) -> set[str]:
    found: set[str] = set()
    for index in range(min(_LOOKED_AT, len(dataset))):
        try:
            photo = dataset[index]
        except DataError:
            continue
        has = {
            protocols.MASK: any(each.mask_path is not None for each in photo.objects),
            protocols.GRAVITY: photo.up is not None,
        }
        found |= {name for name, is_there in has.items() if is_there}
    return found


SPEC = Spec(
    options=PhotosOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize_objects,
    console=_CONSOLE,
    console_note=(
        f"shares count failures; {protocols.SIMULATED}: keypoints projected with the true pose, "
        "with noise"
    ),
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
        "determines it. Simulated: the data set has no keypoints, so that visible points "
        "of the model were projected with the true pose, with noise; all methods get the same."
    ),
)
