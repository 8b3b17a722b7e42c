"""Experiment on data sets of photos: options, names of methods, protocols, summary and page.

A method's name is a base, and further evidence after plus signs, as in ``rigid+mask``.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from cadalign.datasets.pascal3d import Pascal3D
from cadalign.datasets.scan2cad import Scan2CAD
from cadalign.errors import InputError, quote
from cadalign.evaluation import metrics
from cadalign.evaluation.benchmark import VIEW_NAMES
from cadalign.evaluation.metrics import BOX_IOU
from cadalign.evaluation.metrics.photos import (
    MEDIANS,
    RATES,
    ROTATION,
    Protocol,
    measure_box,
    measure_scan2cad,
    measure_viewpoint,
)
from cadalign.evaluation.options import FunctionOptions, is_function
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import LEFT_OUT, Columns, Plan
from cadalign.evaluation.summary import (
    Summary,
    drop_nan,
    mean,
    median,
    medians,
    milliseconds,
    summarize,
)

if TYPE_CHECKING:
    from cadalign.evaluation.instances.sighting import PhotoTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

EPNP, RIGID, STRETCHED, PRIOR, SIMILAR = "epnp", "rigid", "stretched", "prior", "similar"
TRUTH = "truth"
BASES = (EPNP, RIGID, STRETCHED, PRIOR, SIMILAR)
MASK, GRAVITY, IMAGE = "mask", "gravity", "image"
EVIDENCE = (MASK, GRAVITY, IMAGE)


@dataclass(frozen=True)
class PhotosOptions(FunctionOptions):
    """Evaluate methods on photos of real objects, with the metrics of their data set.

    The data set is Scan2CAD, PASCAL3D+ or Pix3D. Methods get the annotated keypoints and the true
    width (x) of the object, as one image does not determine its size. The run's folder gets
    results.parquet with a row per object and method, summary.csv, figures and report.html. An
    interrupted run continues when the same command is started again.
    """

    experiment = "photos"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of the data set; its format is detected."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to use; all by default."""
    methods: tuple[str, ...] = BASES
    """Base methods: epnp; rigid; stretched; prior (stretched, with a prior on the scales); similar
    (like prior, and the object's keypoints differ from the model's by 4 % of its diagonal); truth
    (the annotated pose). rigid, stretched, prior and similar take further evidence: mask, gravity,
    image (the photo itself), as in rigid+mask or similar+mask+gravity."""
    max_photos: int | None = None
    """Use only the first photos, this many; all by default."""
    pictures: int = 100
    """Number of photos with pictures in the report, from the first."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_photos=1, pictures=0)
        own = [each for each in self.methods if not is_function(each)]
        for name in own:
            _check_method(name)
        self.check_methods((*BASES, TRUTH, *own))


def parts_of(method: str) -> tuple[str, frozenset[str]]:
    """Split a method's name into its base and its evidence."""
    base, *evidence = method.split("+")
    return base, frozenset(evidence)


def _check_method(method: str) -> None:
    """Raise InputError for an unknown method, or for evidence with epnp or truth."""
    base, evidence = parts_of(method)
    is_known = base in (*BASES, TRUTH) and evidence <= set(EVIDENCE)
    if not is_known or method.count("+") != len(evidence):
        fix = f"known are {', '.join((*BASES, TRUTH))}, with {', '.join(f'+{e}' for e in EVIDENCE)}"
        raise InputError(f"unknown method {quote(method)}", where="methods", fix=fix)
    if evidence and base in (EPNP, TRUTH):
        fix = "use rigid, stretched, prior or similar with this evidence"
        raise InputError(f"{base} uses keypoints only", where="methods", fix=fix)


_PROTOCOLS = {
    # Annotated points of scan and model differ by about 5 cm: 8 px in an image 480 px wide.
    Scan2CAD.kind: Protocol(
        (measure_viewpoint, measure_scan2cad, measure_box), sigma_of_width=1 / 60
    ),
    Pascal3D.kind: Protocol((measure_viewpoint,), up_axis="z"),
}
_OTHER = Protocol((measure_viewpoint, measure_box))


def protocol_of(kind: str) -> Protocol:
    """The protocol of a kind of data set; errors of viewpoint and box for an unknown kind."""
    return _PROTOCOLS.get(kind, _OTHER)


# Summary ------------------------------------------------------------------------------------------

COLUMNS: Columns = (
    *(*VIEW_NAMES, ("status", str), ("reason", str), ("keypoints", int)),
    ("rms_px", float),
    *((each.key, float) for each in dict.fromkeys((*MEDIANS, *(rate.column for rate in RATES)))),
)
"""Columns of the result table; see docs/formats/runs.md."""


_COUNTS = (metrics.INSTANCES, metrics.FAILED, metrics.LEFT_OUT)
HEADLINE = (
    *(*_COUNTS, metrics.KEYPOINTS, *(rate.metric for rate in RATES), *MEDIANS),
    *(metrics.RMS, metrics.QUERY_MILLISECONDS),
)
_CONSOLE = (
    *(*_COUNTS, *(rate.metric for rate in RATES[:2]), *MEDIANS[:2]),
    *(metrics.RMS, metrics.QUERY_MILLISECONDS),
)


def summarize_objects(run: Run) -> list[Summary]:
    """One summary per category and method, and per method over all categories."""
    known = [rate for rate in RATES if len(drop_nan(run.cells[rate.column.key]))]
    statistics = {
        "keypoints": mean("keypoints"),
        **medians(*MEDIANS),
        **{rate.metric.key: rate.share for rate in known},
        metrics.RMS.key: median(metrics.RMS.key),
        "milliseconds": milliseconds,
    }
    return summarize(run, statistics, apart=LEFT_OUT)


_CURVES = (
    (ROTATION, np.array([0.2, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 45, 90])),
    (replace(BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
)


def plan(options: PhotosOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan a run over the photos of a data set."""
    from cadalign.evaluation.instances.photos import photos_benchmark
    from cadalign.evaluation.instances.sighting import annotations_of, photo_tasks, photos_of

    photos_of.cache_clear()  # the files may have changed in this session
    dataset = photos_of(options.root)
    tasks = photo_tasks(dataset, options.max_photos)
    pictures = folder.made_for_pictures()
    return photos_benchmark(options, pictures).plan(
        options,
        tasks,
        kind=dataset.kind,
        annotations=annotations_of(dataset, tasks),
    )


SPEC = Spec(
    options=PhotosOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize_objects,
    console=_CONSOLE,
    console_note="shares count failures",
    plots=partial(cumulative_curves, curves=_CURVES, of="on photos"),
    apart=LEFT_OUT,
    topic="alignment to photos",
    subject="photos",
    metrics=(*MEDIANS, metrics.RMS),
    about=(
        "Green is the truth, red the estimate of a method: its box, and the model warped to the "
        "estimated shape."
    ),
    note=(
        "Medians over the objects that did not fail; shares count failures as misses. Objects "
        "without camera, model or enough keypoints are left out. Methods get the true width of the "
        "object, as one image does not determine its size."
    ),
)
