"""Specification of the experiment on estimates of other programs."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from cadalign.evaluation.estimates.experiment import estimates_benchmark
from cadalign.evaluation.estimates.files import method_names, opened_estimates
from cadalign.evaluation.estimates.options import EstimatesOptions
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.photos.experiment import COLUMNS
from cadalign.evaluation.photos.options import PhotosOptions
from cadalign.evaluation.photos.spec import GALLERY, HEADLINE, console_table, plots, summarize
from cadalign.evaluation.photos.tasks import PhotoTask, PhotoTasks, opened
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets
from cadalign.evaluation.summary import Conclusion, Summary
from cadalign.io.files import read_bytes

logger = logging.getLogger("cadalign")

_CHUNK = 4
_LOGGED = 10  # problems of a file that are logged


def plan(options: EstimatesOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan the scoring of files of estimates on the photos of a data set."""
    dataset = opened(options.root)
    methods = method_names(options.estimates)
    tasks = PhotoTasks(dataset, options.max_photos)
    unread, strays = {}, {}
    for name, path in zip(methods, options.estimates, strict=True):
        file = opened_estimates(path, dataset)
        unread[name], strays[name] = len(file.problems), file.strays(dataset.names)
        for problem in file.problems[:_LOGGED]:
            logger.warning("%s: left out: %s", name, problem)
    config = {
        **options.as_config(),
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "kind": dataset.kind,
        "estimates": [str(path.absolute()) for path in options.estimates],
        "methods": list(methods),
        "contents": [_fingerprint(path) for path in options.estimates],
        "unread": unread,
        "strays": strays,
        "annotations": tasks.fingerprint(),
    }
    benchmark = estimates_benchmark(options, methods, folder.made_for_pictures())
    return Plan(benchmark, tasks, config, _CHUNK)


def _fingerprint(path: Path) -> str:
    return hashlib.sha256(read_bytes(path)).hexdigest()[:16]


def _describe(run: Run) -> str:
    objects = len({*run.cells["model_id"].tolist()})
    text = f"on {objects:,} objects in photos of {run.dataset} ({run.config.get('kind')})"
    remarks = _remarks(run)
    return f"{text}; {remarks}" if remarks else text


def _remarks(run: Run) -> str:
    """Parts of the files that were not scored."""
    unread, strays = run.config.get("unread") or {}, run.config.get("strays") or {}
    texts = [f"{n} records of {name} could not be read" for name, n in unread.items() if n]
    texts += [f"{n} of {name} are of no photo here" for name, n in strays.items() if n]
    return ", ".join(texts)


def _conclude(run: Run, summaries: Sequence[Summary]) -> Conclusion:
    status = run.results["status"].to_pylist()
    return Conclusion(len(status), status.count("failed"), {}, _remarks(run))


SPEC = Spec(
    options=EstimatesOptions,
    plan=plan,
    results=COLUMNS,
    columns=tuple(each for each in HEADLINE if each.key != metrics.KEYPOINTS.key),
    summarize=summarize,
    table=console_table,
    plots=plots,
    conclude=_conclude,
    # Of the same kind, so that they are compared with methods run on the same photos.
    kind=lambda run: PhotosOptions.experiment,
    title=partial(on_datasets, "estimates of poses"),
    describe=_describe,
    metrics=GALLERY,
    about="Green is the truth, red the estimate of the first file that has one.",
    note=(
        "Medians over the objects that have an estimate, and shares of all, of which those without "
        "count as misses. A photo's n objects of one model are matched with the n estimates of the "
        "highest scores."
    ),
)
