"""The experiment on data sets of photos."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt
import tyro

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.errors import DataError, InputError, quote
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.methods import PNP_METHODS
from cadalign.evaluation.metrics import BOX_IOU
from cadalign.evaluation.metrics.photos import (
    NINE_DOF,
    ROTATION,
    VIEWPOINT,
    measured_columns,
    medians_of,
    score_columns,
    shares_of,
)
from cadalign.evaluation.metrics.scan2cad import SCAN2CAD
from cadalign.evaluation.options import FunctionOptions, PhotoOptions, is_function
from cadalign.evaluation.photos import protocols
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec, count_failures
from cadalign.evaluation.runs.work import FAILED, LEFT_OUT, OK, UNREADABLE, Columns, Plan
from cadalign.evaluation.summary import (
    ALL,
    MEAN,
    Conclusion,
    ConsoleTable,
    Summary,
    mean_of,
    milliseconds,
    summaries_of,
    where,
)

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Cells, Run

COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int), ("source", str)),
    *(("rms_px", float), *score_columns(protocols.SETS)),
)
"""Columns of the result table; see docs/formats/runs.md."""


@dataclass(frozen=True)
class PhotosOptions(FunctionOptions, PhotoOptions, protocols.KeypointOptions):
    """Evaluate methods on photos of real objects, by the metrics of their data set.

    The folder may hold Scan2CAD, PASCAL3D+, ObjectNet3D or Pix3D. Keypoints
    are the annotated or detected ones; where there are none, visible points of the model's mesh are
    projected with the true pose, with noise, and called simulated. The model's width (x) is given,
    as one image leaves size open; with a shape model in metres it is estimated. The
    run's folder gets results.parquet with a row per object and method, summary.csv, figures and
    report.html. A killed run continues when the same command is started again.
    """

    experiment = "photos"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of the data set, in any of the known formats."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to take; all by default."""
    methods: tuple[str, ...] = ()
    """epnp, rigid; stretched, prior (stretched, with a prior on the scales), similar (prior, and
    keypoints that differ from the model's), shape (a shape model); each also with evidence, as in
    rigid+mask, rigid+image (the photo itself) or similar+mask+gravity; and truth. By default the
    first five, shape where there is one, and the evidence that the data have but the image."""
    evidence: tuple[str, ...] = ()
    """mask, gravity, image: what the methods by default get beside keypoints; what the data
    have but the image, where none is named."""
    shape: tuple[Path, ...] = ()
    """Files of `cadalign shape learn`, each for its category."""
    similar_sigma: float = 0.04
    """Standard deviation of the object's keypoints from the model's, for the method similar, in
    diagonals of the model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.similar_sigma < math.inf:
            raise InputError(f"{self.similar_sigma} is not positive", where="similar_sigma")
        self.replace_values(methods=tuple(dict.fromkeys(self.methods)))
        protocols.check_evidence(self.evidence, self.methods)
        names = [each for each in self.methods if not is_function(each)]
        own = [name for name in names if name not in PNP_METHODS]
        for name in own:
            protocols.check_method(name)
        if self.methods:
            self.check_methods((*protocols.BASES, protocols.TRUTH, *own))


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


def summarize(run: Run) -> list[Summary]:
    """A summary for every category and method, for all together, and the mean of categories."""
    marked = {**run.cells, "category": _categories(run.cells)}
    summarize = partial(_summarize, measured=measured_columns(protocols.SETS, run.cells))
    found = summaries_of(marked, run.methods, summarize, further=run.metrics)
    names = dict.fromkeys(each.group for each in found if each.group not in (ALL, UNREADABLE))
    if len(names) < 2:
        return found
    return [*found, *(_mean([s for s in found if s.method == name]) for name in run.methods)]


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


def console_table(run: Run, summaries: Sequence[Summary]) -> ConsoleTable:
    """The summaries for the console: the columns that the data set has."""
    sets = protocols.protocol_of(str(run.config.get("kind"))).metrics
    columns = (
        *(metrics.INSTANCES, metrics.FAILED, metrics.LEFT_OUT),
        *(column for each in sets for column in each.console),
        *(replace(metrics.RMS, symbol="rms px"), metrics.QUERY_MILLISECONDS),
        *run.metrics,
    )
    shown = [c for c in columns if metrics.told(c, [each.number(c.key) for each in summaries])]
    has_simulated = any(protocols.SIMULATED in each.group for each in summaries)
    more = f"; {protocols.SIMULATED}: keypoints projected with the true pose, with noise"
    return ConsoleTable.of(
        "Medians and shares per category and method",
        summaries,
        shown,
        note=f"shares count failures{more if has_simulated else ''}",
        narrow=True,
        wraps=True,
    )


def _summarize(category: str, method: str, cells: Cells, *, measured: Collection[str]) -> Summary:
    chosen = where(cells, cells["method"] == method)
    left_out = chosen["status"] == LEFT_OUT
    rated = where(chosen, ~left_out)
    solved = where(rated, rated["status"] == OK)
    values = {
        "instances": len(rated["method"]),
        "failed": int((rated["status"] == FAILED).sum()),
        metrics.LEFT_OUT.key: int(left_out.sum()),
        "keypoints": mean_of(solved["keypoints"]),
        **medians_of(protocols.SETS, solved, metrics.RMS),
        **shares_of(protocols.SETS, rated, solved, measured=measured),
        "milliseconds": milliseconds(solved),
    }
    return Summary(category, {"category": category, "method": method}, values)


def _mean(found: Sequence[Summary]) -> Summary:
    """The mean of a method's values over categories; its counts are those of all."""
    (every,) = (each for each in found if each.group == ALL)
    single = [each for each in found if each.group not in (ALL, UNREADABLE)]
    counts = ("instances", "failed", metrics.LEFT_OUT.key)
    values = {
        key: value if key in counts else mean_of(np.array([each.values[key] for each in single]))
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
_LOOKED_AT = 20  # photos that say which evidence the data set has


def plan(options: PhotosOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan a run over the photos of a data set."""
    from cadalign.evaluation.photos.objects import photos_benchmark
    from cadalign.evaluation.photos.target import PhotoTasks, reopened
    from cadalign.evaluation.shape_files import shapes_fingerprint, shapes_of

    dataset = reopened(options.root)
    protocol = protocols.protocol_of(dataset.kind)
    shapes = shapes_of(options.shape)
    if not options.methods:
        methods = protocols.default_methods(
            with_evidence=tuple(dict.fromkeys((protocols.RIGID, protocol.best))),
            evidence=set(options.evidence) or _evidence(dataset),
            has_shape=bool(shapes),
        )
        options = replace(options, methods=methods, evidence=())
    tasks = PhotoTasks(dataset, options.max_photos)
    pictures = folder.made_for_pictures()
    chunk = _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    return photos_benchmark(options, shapes, pictures).plan(
        options,
        tasks,
        chunk=chunk,
        kind=dataset.kind,
        shapes=shapes_fingerprint(shapes),
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


def _describe(run: Run) -> str:
    status, source = run.cells["status"], run.cells["source"]
    objects = len({*run.cells["model_id"][status != LEFT_OUT].tolist()})
    simulated = len({*run.cells["model_id"][source == protocols.SIMULATED].tolist()})
    text = f"on {objects:,} objects in photos of {run.dataset} ({run.config.get('kind')})"
    if not simulated:
        return text
    whose = "whose" if simulated == objects else f"the keypoints of {simulated:,} of which"
    keypoints = "keypoints " if simulated == objects else ""
    noise = run.config.get("simulated_noise_px") or 0
    return f"{text}, {whose} {keypoints}are simulated: projected with the true pose, {noise:g} px"


def _conclude(run: Run, summaries: Sequence[Summary]) -> Conclusion:
    """Counts, and categories that no object is of."""
    found = count_failures(run, summaries, apart=LEFT_OUT)
    missing = set(run.config.get("categories") or ()).difference(run.cells["category"].tolist())
    names = ", ".join(quote(name) for name in sorted(missing))
    note = ", ".join(filter(None, (found.note, names and f"no object is a {names}")))
    return replace(found, note=note)


SPEC = Spec(
    options=PhotosOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize,
    table=console_table,
    plots=plots,
    conclude=_conclude,
    topic="alignment to photos",
    describe=_describe,
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
