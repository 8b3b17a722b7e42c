"""The experiment on data sets of photos: options, names of methods, protocols, summary and page.

A method's name is a base, and the evidence beside the keypoints, as in ``rigid+mask``.
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
    statistics_of,
)
from cadalign.evaluation.options import FunctionOptions, is_function
from cadalign.evaluation.plots import cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import LEFT_OUT, Columns, Plan
from cadalign.evaluation.summary import (
    Summary,
    mean,
    median,
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
    """Evaluate methods on photos of real objects, by the metrics of their data set.

    The data set is Scan2CAD, PASCAL3D+ or Pix3D. Methods get the annotated keypoints, and the
    model's width (x), since one image does not determine size. Writes results.parquet with a row
    per object and method, summary.csv, figures and report.html. A killed run continues when the
    same command is started again.
    """

    experiment = "photos"

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of the data set."""
    _: KW_ONLY
    categories: tuple[str, ...] | None = None
    """Categories to use; all by default."""
    methods: tuple[str, ...] = BASES
    """Methods to compare: epnp, rigid, stretched, prior (stretched, with a prior on the scales),
    similar (prior, with keypoints that differ from the model's by 4 % of its diagonal) and truth.
    All but epnp and truth can have evidence added: rigid+mask, rigid+image (the photo itself),
    similar+mask+gravity."""
    max_photos: int | None = None
    """Number of photos to use, from the first; all by default."""
    pictures: int = 100
    """Number of photos to show in the report, from the first."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(max_photos=1, pictures=0)
        own = [each for each in self.methods if not is_function(each)]
        for name in own:
            _check_method(name)
        self.check_methods((*BASES, TRUTH, *own))


def parts_of(method: str) -> tuple[str, frozenset[str]]:
    """The base of a method, and its evidence."""
    base, *evidence = method.split("+")
    return base, frozenset(evidence)


def _check_method(method: str) -> None:
    """Check that there is a method of a name, and that EPnP and the truth are given no evidence."""
    base, evidence = parts_of(method)
    is_known = base in (*BASES, TRUTH) and evidence <= set(EVIDENCE)
    if not is_known or method.count("+") != len(evidence):
        fix = f"known are {', '.join((*BASES, TRUTH))}, with {', '.join(f'+{e}' for e in EVIDENCE)}"
        raise InputError(f"unknown method {quote(method)}", where="methods", fix=fix)
    if evidence and base in (EPNP, TRUTH):
        fix = "give rigid, stretched, prior or similar the evidence"
        raise InputError(f"{base} takes keypoints alone", where="methods", fix=fix)


_PROTOCOLS = {
    # Annotators' points on scan and model are about 5 cm apart, 8 px in an image of 480.
    Scan2CAD.kind: Protocol(
        (measure_viewpoint, measure_scan2cad, measure_box), sigma_of_width=1 / 60
    ),
    Pascal3D.kind: Protocol((measure_viewpoint,), up_axis="z"),
}
_OTHER = Protocol((measure_viewpoint, measure_box))


def protocol_of(kind: str) -> Protocol:
    """The protocol of a data set's kind; of another one, viewpoint and box."""
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
    *(replace(metrics.RMS, symbol="rms px"), metrics.QUERY_MILLISECONDS),
)


def summarize_objects(run: Run) -> list[Summary]:
    """A summary for every category and method, and for all together."""
    cells = run.cells
    statistics = {
        "keypoints": mean("keypoints"),
        **statistics_of(cells),
        metrics.RMS.key: median(metrics.RMS.key),
        "milliseconds": milliseconds,
    }
    return summarize(run, statistics, apart=LEFT_OUT)


_CURVES = (
    (ROTATION, np.array([0.2, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 45, 90])),
    (replace(BOX_IOU, log=False), np.arange(0, 1.01, 0.05)),
)


_CHUNK = 8


def plan(options: PhotosOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan a run over the photos of a data set."""
    from cadalign.evaluation.instances.photos import photos_benchmark
    from cadalign.evaluation.instances.sighting import annotations_of, photo_tasks, reopened

    dataset = reopened(options.root)
    tasks = photo_tasks(dataset, options.max_photos)
    pictures = folder.made_for_pictures()
    return photos_benchmark(options, pictures).plan(
        options,
        tasks,
        chunk=_CHUNK,
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
        "Green is the truth, red what a method found: its box, and the model warped to the "
        "estimated shape."
    ),
    note=(
        "Medians over the objects that did not fail, and shares of all, of which failures count as "
        "misses; objects without camera, model or enough keypoints are left out. The model's width "
        "is the object's, as one image leaves size open."
    ),
)
