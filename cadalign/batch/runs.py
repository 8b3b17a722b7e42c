"""Runs over many observations: options, their tasks and rows, `run_many` and `fit_many`."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

from cadalign.arrays import worker_count
from cadalign.batch.observation_fit import ObservationFit
from cadalign.batch.outputs import (
    COLUMNS,
    RECORD_COLUMNS,
    draw_fit,
    json_of,
    name_cells,
    result_row,
    write_csv,
)
from cadalign.batch.sources import ObservationTask, ObservationTasks
from cadalign.datasets.image_keypoints import ImageKeypoints, find_photo, observe_keypoints
from cadalign.datasets.model_keypoints import ModelKeypoints
from cadalign.errors import CadalignError, DataError, InputError, quote, require_kind
from cadalign.estimation.result import Result
from cadalign.estimation.results import Results
from cadalign.evaluation.options import ExperimentOptions, absolute_paths
from cadalign.evaluation.runs.engine import OnProgress, execute, workers_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import Columns, Plan, Row, fingerprint
from cadalign.export.results import failed_row
from cadalign.io.documents import name_file, parse_json
from cadalign.io.files import as_path, create_folder, read_bytes, write_text
from cadalign.io.images import photo_size, require_one_size
from cadalign.io.observation import DetectorOptions, Observation, ObservationChanges
from cadalign.io.pretrained import shape_path

LARGEST_CHUNK = 512
"""Maximum number of observations in a chunk, the work of one worker at a time."""
_LEAST_CHUNKS = 64  # per run, so that all workers are busy until its end
_FEW = 200  # observations: they are aligned before processes have started

Estimate = tuple[Observation, Result, Row]
"""The aligned observation, its result, and further cells of the table."""


@dataclass(frozen=True, kw_only=True)
class FitRunOptions(ExperimentOptions):
    """Options of a run that aligns many observations."""

    experiment: ClassVar[str] = "fit"
    command: ClassVar[str] = "fit"
    columns: ClassVar[Columns] = ()
    """Further columns of the table."""
    threads: ClassVar[int] = 1
    """Number of threads of a run without workers; -1 for one per core."""

    inputs: tuple[Path, ...] = ()
    """Observation files, folders of observation files, JSON lines, or detectors' files."""
    changes: ObservationChanges = field(default_factory=ObservationChanges)
    """Camera that replaces the cameras of the observations."""
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    pictures: int = 0
    """Number of observations with pictures on the page, from the first."""
    estimate: ObservationFit = field(default_factory=ObservationFit)

    def __post_init__(self) -> None:
        super().__post_init__()
        own = self.estimate
        if own.shape is not None:
            object.__setattr__(self, "estimate", replace(own, shape=shape_path(own.shape)))
        self.check_least(pictures=0)

    @property
    def files(self) -> tuple[Path | None, ...]:
        """The files that the estimates depend on, besides the observations."""
        return self.changes.camera, self.detector.model, self.estimate.shape

    def keypoints(self) -> ModelKeypoints | None:
        """Return the keypoints of the learned shape, for a detector's file without a model.

        Raises CadalignError if an option of the estimate is invalid, or the shape cannot be read.
        """
        self.estimate.check()
        if self.estimate.shape is None:
            return None
        from cadalign.shapes.model import open_shape  # takes time to import

        return ModelKeypoints.from_shape(open_shape(self.estimate.shape))

    def estimate_of(self, seen: Observation, where: str) -> Estimate:
        """Align an observation; raises CadalignError if that fails."""
        seen = self.estimate.override(seen)
        return seen, self.estimate.fit(seen, where), {}


@dataclass(frozen=True)
class ManyEstimates:
    """The experiment of a run; see `cadalign.evaluation.runs.work.Experiment`."""

    options: FitRunOptions
    model: ModelKeypoints | None = None
    """Model whose keypoints a detector's keypoints are matched to."""
    folder: RunFolder | None = field(default=None, repr=False)
    """Folder for pictures; without it, none are drawn."""
    record_columns: Columns = RECORD_COLUMNS

    @property
    def columns(self) -> Columns:
        """The columns of the table."""
        return COLUMNS + self.options.columns

    def evaluate(self, tasks: Sequence[ObservationTask]) -> list[Row]:
        """The rows of some observations."""
        return [self._evaluate(task) for task in tasks]

    def failure(self, task: ObservationTask, reason: str) -> list[Row]:
        """The row of an observation whose worker died or raised an unexpected error."""
        named = name_cells(task.row, task.name, None)
        return [named | failed_row(reason) | {"observation": "", "result": ""}]

    def _evaluate(self, task: ObservationTask) -> Row:
        start, seen, result = time.perf_counter(), None, None
        try:
            seen = self._observation(task)
            seen, result, cells = self.options.estimate_of(seen, task.name)
            row = result_row(result) | cells | {"seconds": time.perf_counter() - start}
        except CadalignError as error:
            text = "" if seen is None else json_of(seen.to_dict()).decode()
            row = failed_row(str(error)) | {"observation": text, "result": ""}
        row |= name_cells(task.row, task.name, seen)
        if seen is not None:
            undrawn: tuple[str, ...] = ()
            if self.folder is not None and task.row < self.options.pictures:
                undrawn = draw_fit(self.folder, row, seen, result)
            if result is not None:
                warnings = [*(("picture", text) for text in undrawn), *_doubts(seen)]
                row["warning_count"] += len(warnings)
                for column, name in enumerate(("warning_kinds", "warnings")):
                    texts = row[name], *(each[column] for each in warnings)
                    row[name] = "; ".join(filter(None, texts))
        return row

    def _observation(self, task: ObservationTask) -> Observation:
        folder, content, options = Path(task.folder), task.content, self.options
        if isinstance(content, DataError):
            raise content
        if not isinstance(content, ImageKeypoints):
            data, changes = parse_json(content, task.name), options.changes
            return options.estimate.read(data, task.name, folder=folder, changes=changes)
        detector = options.detector
        assert self.model is not None
        photos, named = detector.images or folder, content.image
        with name_file(content.source):
            return observe_keypoints(
                content,
                self.model,
                options.changes,
                image=None if named is None else _photo_in(photos, named),
                min_score=detector.min_score,
                ignore_unknown=detector.ignore_unknown,
            )


_photo_in = lru_cache(maxsize=1024)(find_photo)


def _doubts(seen: Observation) -> Iterator[tuple[str, str]]:
    """Yield kinds and texts of warnings about views: keypoints left out, photos of another size.

    Unreadable photos are reported when they are drawn.
    """
    for view in seen.views:
        if view.text_of_not_found:
            yield "left-out", view.text_of_not_found
        if view.image is None:
            continue
        known = {"its camera": (view.camera.width, view.camera.height)}
        try:
            known[view.image.name] = photo_size(view.image)
        except DataError:
            continue
        try:
            require_one_size(known, view.image)
        except DataError as error:
            yield "camera", f"{error} (`Camera.resize`, `Camera.crop`)"


def plan_run(options: FitRunOptions, folder: RunFolder) -> Plan[ObservationTask]:
    """Plan a run over the observations of all inputs.

    Raises CadalignError if an option is invalid, an input or the camera cannot be read, or a
    detector's file lacks its model or photos.
    """
    options.changes.read_camera((1, 1))  # of any size: reports an error once, not per row
    model, photos = options.keypoints(), options.detector.images
    tasks = ObservationTasks(options.inputs)
    if photos is not None and not photos.is_dir():
        what = f"{photos} is not a folder of photos"
        raise InputError(what, where="images", fix="give the photos' folder, or leave it out")
    if options.detector.model is not None and tasks.has_detections:
        model = ModelKeypoints.load(options.detector.model)
    if model is None and tasks.has_detections:
        fix = "give the model's NAME.keypoints.json, or a learned shape"
        raise InputError("a detector's file needs a model", where="model", fix=fix)
    read = (read_bytes(path) for path in options.files if path is not None and path.is_file())
    config = options.as_config() | {"contents": fingerprint(tasks.fingerprint, *read)}
    drawn_in = folder.made_for_pictures() if options.pictures else None
    chunk = max(1, min(LARGEST_CHUNK, len(tasks) // _LEAST_CHUNKS))
    estimates = ManyEstimates(absolute_paths(options), model, drawn_in)
    return Plan(estimates, tasks, config, chunk)


def run_many(
    options: FitRunOptions,
    out: str | os.PathLike[str],
    *,
    workers: int | None = None,
    dask: str | None = None,
    on_progress: OnProgress = lambda progress: None,
) -> None:
    """Align many observations, or retrieve their models, as a run that can be continued.

    Parameters
    ----------
    options : FitRunOptions or RetrieveRunOptions
        The inputs, and the options of each estimate.
    out : path-like
        Folder of the run. It gets ``results.parquet`` and ``results.csv``, and can be opened by
        `cadalign.Results.open`. With the same options, a killed run is continued, and a finished
        run is left unchanged.
    workers : int, optional
        Number of processes: -1 for one per core, 0 to use none. By default -1, or 0 for fewer than
        200 observations.
    dask : str, optional
        Address of a Dask scheduler. Its workers are used instead of local processes.
    on_progress : callable
        Function called after every chunk.

    Raises
    ------
    InputError
        If an option is invalid.
    DataError
        If an input cannot be read, or the folder holds another run or cannot be written to.

    Examples
    --------
    >>> linear = ObservationFit(method="aepnp")
    >>> options = FitRunOptions(inputs=(Path("seen.jsonl"),), estimate=linear)
    >>> run_many(options, "runs/boxes")  # doctest: +SKIP
    >>> results = cadalign.Results.open("runs/boxes")  # doctest: +SKIP
    """
    folder = RunFolder(as_path(out, "out"))
    plan = plan_run(options, folder)
    if workers is None:
        workers = 0 if len(plan.tasks) < _FEW else -1
    pool = workers_of(workers, dask, threads=worker_count(options.threads))
    execute(plan, folder, workers=pool, on_progress=on_progress)
    write_csv(folder)


def fit_many(
    observations: str | os.PathLike[str] | Iterable[Any],
    *,
    out: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    dask: str | None = None,
    pictures: int = 0,
    changes: ObservationChanges | None = None,
    detector: DetectorOptions | None = None,
    **options: Any,
) -> Results:
    """Align many observations, as `cadalign fit` does, and return their results.

    Parameters
    ----------
    observations : path, or iterable of path or of Observation
        Observation files, folders of observation files, JSON lines, or detectors' files; or
        `Observation` objects, which are written as JSON lines.
    out : path-like, optional
        Folder of the run, see `run_many`. `Observation` objects are written beside it, as
        ``<out>.jsonl``. Without a folder, no file is kept.
    workers, dask
        See `run_many`.
    pictures : int
        Number of observations with pictures on the page, from the first.
    changes : ObservationChanges, optional
        Camera that replaces the cameras of the observations.
    detector : DetectorOptions, optional
        Model and photos of a detector's file.
    **options
        Fields of `cadalign.batch.ObservationFit`, such as ``method``, ``similar``, ``robust``,
        ``loss``, ``shape``. By default the observations' own settings. ``sigma="none"`` estimates
        the standard deviation.

    Returns
    -------
    Results
        One entry per observation, in their order: the result, or the error of a failed alignment.

    Raises
    ------
    InputError
        If an option is invalid or unknown, or there are no observations.
    DataError
        If an input cannot be read, or the folder holds another run or cannot be written to.

    Examples
    --------
    >>> import numpy as np
    >>> from cadalign import Camera, Observation
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> seen = (
    ...     Observation(corners, camera.project(corners + [0.1, 0.2, depth]), camera)
    ...     for depth in (5.0, 6.0)
    ... )
    >>> fit_many(seen, method="aepnp").translation[:, 2].round(3).tolist()
    [5.0, 6.0]
    """
    known = [each.name for each in fields(ObservationFit)]
    if unknown := set(options) - set(known):
        what = f"not an option: {', '.join(map(quote, sorted(unknown)))}"
        raise InputError(what, where="options", fix=f"known are {', '.join(known)}")
    if options.get("shape") is not None:
        options["shape"] = as_path(options["shape"], "shape")
    with TemporaryDirectory(prefix="cadalign-") as scratch:
        folder = Path(scratch) / "run" if out is None else as_path(out, "out")
        chosen = FitRunOptions(
            inputs=_inputs(observations, folder.with_name(f"{folder.name}.jsonl")),
            changes=changes or ObservationChanges(),
            detector=detector or DetectorOptions(),
            pictures=pictures,
            estimate=ObservationFit(**options),
        )
        run_many(chosen, folder, workers=workers, dask=dask)
        results = Results.open(folder)
        if out is None:
            list(results)  # reads all results before the folder is deleted
        return results


def _inputs(observations: Any, beside: Path) -> tuple[Path, ...]:
    """Return the paths of inputs; writes observations as JSON lines to the file ``beside``."""
    if isinstance(observations, str | os.PathLike):
        observations = [observations]
    try:
        given = list(observations)
    except TypeError:
        what = f"expected a path or a sequence, got {type(observations).__name__}"
        raise InputError(what, where="observations", fix="give a list") from None
    if not given:
        raise InputError("none are given", where="observations")
    if isinstance(given[0], str | os.PathLike):
        return tuple(as_path(each, f"observations[{k}]") for k, each in enumerate(given))
    for number, each in enumerate(given):
        require_kind(each, Observation, f"observations[{number}]")
    create_folder(beside.parent)
    lines = [json_of(each.to_dict(folder=beside.absolute().parent)).decode() for each in given]
    text = "".join(f"{line}\n" for line in lines)
    if beside.exists() and read_bytes(beside) != text.encode():
        what, fix = "holds the observations of another run", "give another folder as out"
        raise DataError(what, where=str(beside), fix=fix)
    write_text(beside, text)
    return (beside,)
