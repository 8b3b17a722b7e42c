"""The experiment on poses that other programs estimated, read from their files."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from cadalign.errors import InputError, quote
from cadalign.evaluation.experiments.photos import (
    COLUMNS,
    GALLERY,
    HEADLINE,
    PhotosOptions,
    console_table,
    plots,
    summarize,
)
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.options import PhotoOptions
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.work import Plan, fingerprint
from cadalign.evaluation.summary import Conclusion, Summary
from cadalign.io.files import read_bytes

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTask
    from cadalign.evaluation.runs.folder import RunFolder
    from cadalign.evaluation.runs.tables import Run

logger = logging.getLogger("cadalign")

_CHUNK = 4
_LOGGED = 10  # problems of a file that are logged


@dataclass(frozen=True)
class EstimatesOptions(PhotoOptions):
    """Score poses that other programs estimated, on photos of a data set.

    The files are BOP's results (CSV) or ``scene_gt.json``, or JSON in the form of Scan2CAD's
    annotations; each is a method, named after its file.
    """

    experiment = "estimates"
    command: ClassVar[str] = "report"

    root: Path
    """Folder of the data set."""
    _: KW_ONLY
    estimates: tuple[Path, ...] = ()
    """Files of estimates."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.estimates:
            raise InputError("give at least one file", where="estimates")

    @property
    def default_workers(self) -> int:
        """None: starting them takes longer than scoring the poses of hundreds of photos."""
        return 0


def method_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A name for each file: its own, with its folder's and with the ending where that is needed.

    Raises InputError if a file is given twice.
    """
    twice = next((each for row, each in enumerate(paths) if each in paths[:row]), None)
    if twice is not None:
        raise InputError(f"{quote(str(twice))} is given twice", where="estimates")
    general = ("scene_gt", "annotations", "full_annotations")
    names = [
        f"{path.absolute().parent.name}/{path.stem}" if path.stem in general else path.stem
        for path in paths
    ]
    whole = [path.as_posix() for path in paths]
    for longer in ([path.with_suffix("").as_posix() for path in paths], whole):
        names = longer if len(set(names)) < len(names) else names
    return tuple(names)


def plan(options: EstimatesOptions, folder: RunFolder) -> Plan[PhotoTask]:
    """Plan the scoring of files of estimates on the photos of a data set."""
    from cadalign.evaluation.photos.given import estimates_benchmark, opened_estimates
    from cadalign.evaluation.photos.target import PhotoTasks, reopened

    dataset = reopened(options.root)
    methods = method_names(options.estimates)
    tasks = PhotoTasks(dataset, options.max_photos)
    unread, strays = {}, {}
    for name, path in zip(methods, options.estimates, strict=True):
        file = opened_estimates(path, dataset)
        unread[name], strays[name] = len(file.problems), file.strays(dataset.names)
        for problem in file.problems[:_LOGGED]:
            logger.warning("%s: left out: %s", name, problem)
    pictures = folder.made_for_pictures()
    return estimates_benchmark(dataset.kind, options, methods, pictures).plan(
        options,
        tasks,
        chunk=_CHUNK,
        kind=dataset.kind,
        methods=list(methods),
        contents=[fingerprint(read_bytes(path)) for path in options.estimates],
        unread=unread,
        strays=strays,
        annotations=tasks.fingerprint(),
    )


def _describe(run: Run) -> str:
    objects = len({*run.cells["model_id"].tolist()})
    text = f"on {objects:,} objects in photos of {run.dataset} ({run.config.get('kind')})"
    remarks = _remarks(run)
    return f"{text}; {remarks}" if remarks else text


def _remarks(run: Run) -> str:
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
    topic="estimates of poses",
    describe=_describe,
    metrics=GALLERY,
    about="Green is the truth, red the estimate of the first file that has one.",
    note=(
        "Medians over the objects that have an estimate, and shares of all, of which those without "
        "count as misses. A photo's n objects of one model are matched with the n estimates of the "
        "highest scores."
    ),
)
