"""Specification of the experiment on data sets of photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.errors import DataError
from cadalign.evaluation.outcome import FAILED, LEFT_OUT
from cadalign.evaluation.photos.experiment import COLUMNS, photos_benchmark
from cadalign.evaluation.photos.figures import plots
from cadalign.evaluation.photos.names import DEPTH, GRAVITY, MASK, RIGID, default_methods
from cadalign.evaluation.photos.options import PhotosOptions
from cadalign.evaluation.photos.protocols import protocol_of
from cadalign.evaluation.photos.shapes import fingerprint, shapes_of
from cadalign.evaluation.photos.sighting import SIMULATED
from cadalign.evaluation.photos.summary import GALLERY, HEADLINE, console_table, summarize
from cadalign.evaluation.photos.tasks import PhotoTask, PhotoTasks, opened
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets
from cadalign.evaluation.summary import Conclusion, Summary

_CHUNK, _LARGE_CHUNK = 4, 32
_LARGE = 500  # photos
_LOOKED_AT = 20  # photos that say which evidence the data set has


def plan(options: PhotosOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan a run over the photos of a data set."""
    dataset = opened(options.root)
    protocol = protocol_of(dataset.kind)
    shapes = shapes_of(options.shape, dataset.root)
    if not options.methods:
        methods = default_methods(
            with_evidence=tuple(dict.fromkeys((RIGID, protocol.best))),
            evidence=_evidence(dataset),
            has_shape=bool(shapes),
            up_axis=protocol.up_axis,
        )
        options = replace(options, methods=methods)
    tasks = PhotoTasks(dataset, options.max_photos)
    config = {
        **options.as_config(),
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "kind": dataset.kind,
        "shape": [str(path.absolute()) for path in options.shape],
        "shapes": fingerprint(shapes),
        "annotations": tasks.fingerprint(),
    }
    pictures = folder.made_for_pictures()
    chunk = _CHUNK if len(tasks) < _LARGE else _LARGE_CHUNK
    benchmark = photos_benchmark(options, shapes, pictures)
    return Plan(benchmark, tasks, config | benchmark.config, chunk)


def _evidence(dataset: PhotoDataset) -> set[str]:
    """The evidence that the first photos have."""
    found: set[str] = set()
    for index in range(min(_LOOKED_AT, len(dataset))):
        try:
            photo = dataset[index]
        except DataError:
            continue
        has = {
            MASK: any(each.mask_path is not None for each in photo.objects),
            DEPTH: photo.depth is not None,
            GRAVITY: photo.up is not None,
        }
        found |= {name for name, is_there in has.items() if is_there}
    return found


def _describe(run: Run) -> str:
    status, source = run.cells["status"], run.cells["source"]
    objects = len({*run.cells["model_id"][status != LEFT_OUT].tolist()})
    simulated = len({*run.cells["model_id"][source == SIMULATED].tolist()})
    text = f"on {objects:,} objects in photos of {run.dataset} ({run.config.get('kind')})"
    if not simulated:
        return text
    whose = "whose" if simulated == objects else f"the keypoints of {simulated:,} of which"
    keypoints = "keypoints " if simulated == objects else ""
    noise = run.config.get("simulated_noise_px") or 0
    return f"{text}, {whose} {keypoints}are simulated: projected with the true pose, {noise:g} px"


def _conclude(run: Run, summaries: Sequence[Summary]) -> Conclusion:
    status: Any = run.cells["status"]
    left_out = int(np.sum(status == LEFT_OUT))
    note = f"{left_out} more were left out" if left_out else ""
    rows, failed = len(status) - left_out, int(np.sum(status == FAILED))
    return Conclusion(rows, failed, {"left_out": left_out}, note)


SPEC = Spec(
    options=PhotosOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize,
    table=console_table,
    plots=plots,
    conclude=_conclude,
    title=partial(on_datasets, "alignment to photos"),
    describe=_describe,
    metrics=GALLERY,
    about=(
        "Green is the truth, red what a method found: its box, and the model warped to the "
        "estimated shape."
    ),
    note=(
        "Medians over the objects that did not fail, and shares of all, of which failures count as "
        "misses; objects without camera, model or enough keypoints are left out. The model's width "
        "is the object's, as one image does not tell size, where neither depth nor a shape model "
        "in metres does. Simulated: the data set has no keypoints, so that visible points of the "
        "model were projected with the true pose, with noise; all methods get the same."
    ),
)
