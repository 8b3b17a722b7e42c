"""Runs over many observations, as the engine of runs sees them: options, tasks and their rows."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np

from cadalign.batch.observation_fit import ObservationFit, opened_shape
from cadalign.batch.outputs import COLUMNS, RECORD_COLUMNS, draw_fit, naming_row, result_row
from cadalign.batch.sources import ObservationTask, ObservationTasks
from cadalign.datasets.image_keypoints import ImageKeypoints, observed_in, photo_in
from cadalign.datasets.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.estimation.result import Result
from cadalign.evaluation.options import ExperimentOptions, absolute_paths
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import Columns, Plan, Row, fingerprint
from cadalign.export.results import failed_row
from cadalign.io.documents import in_file, parse_json
from cadalign.io.evidence import ObservedImage
from cadalign.io.files import read_bytes
from cadalign.io.images import photo_size, require_one_size
from cadalign.io.observation import DetectorOptions, Observation, ObservationChanges

LARGEST_CHUNK = 256
"""Most observations that a worker gets at a time, as of every long run."""
_LEAST_CHUNKS = 64  # of a run, such that workers share the last ones evenly
# Several times as fast as the standard library's; numbers that are not finite become null.
_ENCODER = msgspec.json.Encoder(enc_hook=np.generic.item)


Estimated = tuple[Observation, Result, Row]
"""What is aligned, its result, and further cells of the tables."""


@dataclass(frozen=True, kw_only=True)
class ManyOptions(ExperimentOptions):
    """A run over many observations, whatever is estimated of each."""

    columns: ClassVar[Columns] = ()
    """Columns of the table beside those of every run."""

    inputs: tuple[Path, ...]
    """Observation files, folders of such, JSON lines, files of detectors."""
    changes: ObservationChanges = field(default_factory=ObservationChanges)
    """Takes the place of the observations' own."""
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    pictures: int = 0
    """Number of observations whose photos the page shows, the first ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(pictures=0)

    @property
    def threads(self) -> int:
        """Number of threads of a run without workers."""
        return 1

    @property
    def learned(self) -> Path | None:
        """The learned shape that keypoints of detectors may be named after."""
        raise NotImplementedError

    def own_keypoints(self) -> ModelKeypoints:
        """Those that a detector's are paired with, where no model's are given."""
        if self.learned is None:
            fix = "give the model's NAME.keypoints.json, or a learned shape"
            what = "the keypoints of the model are not known"
            raise InputError(what, where="model", fix=fix)
        shape = opened_shape(self.learned)
        named = isinstance(shape.ids[0], str)
        pairs = zip(shape.ids, shape.components[0].mean.tolist(), strict=False)
        return ModelKeypoints(
            tuple(ModelKeypoint(str(k), tuple(xyz), None if named else int(k)) for k, xyz in pairs)
        )

    def read(self, data: Any, where: str, *, folder: Path) -> Observation:
        """Read the parsed form of an observation, which messages call ``where``."""
        raise NotImplementedError

    def estimate_of(self, seen: Observation, where: str) -> Estimated:
        """Estimate the object of an observation; raises CadalignError if it cannot be."""
        raise NotImplementedError

    def check_files(self) -> None:
        """Refuse files of the estimate that cannot be read."""

    def contents(self) -> dict[str, Any]:
        """Entries of a run's configuration that change with the contents of the options' files."""
        paths = (path for path in _paths(asdict(replace(self, inputs=()))) if path.is_file())
        found = {os.path.abspath(path): fingerprint(read_bytes(path)) for path in paths}
        return {"files": found} if found else {}


@dataclass(frozen=True, kw_only=True)
class FitRunOptions(ManyOptions):
    """A run that aligns many observations, as ``estimate`` says; see `ManyOptions`."""

    experiment: ClassVar[str] = "fit"
    command: ClassVar[str] = "fit"

    estimate: ObservationFit = field(default_factory=ObservationFit)

    @property
    def learned(self) -> Path | None:
        return self.estimate.shape

    def read(self, data: Any, where: str, *, folder: Path) -> Observation:
        return self.estimate.read(data, where, folder=folder, changes=self.changes)

    def estimate_of(self, seen: Observation, where: str) -> Estimated:
        return seen, self.estimate.fit(seen, where), {}

    def check_files(self) -> None:
        if self.estimate.shape is not None:
            opened_shape(self.estimate.shape)


def _add_warnings(row: Row, seen: Observation, undrawn: Sequence[str]) -> None:
    """Add what is wrong with an aligned observation's photos to the warnings of its row."""
    troubles = {
        "picture": undrawn,
        "camera": [_photo_doubt(view) for view in seen.views],
        "left-out": [view.text_of_not_found for view in seen.views],
    }
    told = [(kind, text) for kind, texts in troubles.items() for text in texts if text]
    row["warning_count"] += len(told)
    for column, name in enumerate(("warning_kinds", "warnings")):
        row[name] = "; ".join(filter(None, (row[name], *(each[column] for each in told))))


def _photo_doubt(view: ObservedImage) -> str:
    """Warning about a photo, if it can be read, of another size than its camera's images."""
    if view.image is None:
        return ""
    with suppress(DataError):  # which whoever draws it will name
        size, camera = photo_size(view.image), view.camera
        try:
            named = {"its camera": (camera.width, camera.height), view.image.name: size}
            require_one_size(named, view.image)
        except DataError as error:
            return f"{error} (`Camera.resized`, `Camera.cropped`)"
    return ""


def _paths(value: Any) -> Iterator[Path]:
    """All paths in mappings and lists."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, dict | list | tuple):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _paths(each)


@dataclass(frozen=True)
class ManyEstimates:
    """Estimates of observations; see `cadalign.evaluation.runs.work.Experiment`."""

    options: ManyOptions
    model: ModelKeypoints | None = None
    """The keypoints that a detector's are paired with."""
    folder: RunFolder | None = field(default=None, repr=False)
    """The folder that pictures go to; none are drawn without."""
    record_columns: Columns = RECORD_COLUMNS
    """The columns of the table of observations and results."""

    @property
    def columns(self) -> Columns:
        """The columns of the table."""
        return COLUMNS + self.options.columns

    def evaluate(self, tasks: Sequence[ObservationTask]) -> list[Row]:
        """The rows of some observations."""
        return [self._evaluate(task) for task in tasks]

    def failure(self, task: ObservationTask, reason: str) -> list[Row]:
        """The row of an observation whose worker died, or that raised what nobody foresaw."""
        return [naming_row(task.row, task.name, None) | failed_row(reason) | _record(None, None)]

    def _evaluate(self, task: ObservationTask) -> Row:
        start, seen, result = time.perf_counter(), None, None
        try:
            seen = self._observation(task)
            seen, result, cells = self.options.estimate_of(seen, task.name)
            found = result_row(result) | cells | {"seconds": time.perf_counter() - start}
        except CadalignError as error:
            found = failed_row(str(error))
        row = naming_row(task.row, task.name, seen) | found | _record(seen, result)
        undrawn: tuple[str, ...] = ()
        if seen is not None and self.folder is not None and task.row < self.options.pictures:
            undrawn = draw_fit(self.folder, row, seen, result)
        if seen is not None and result is not None:
            _add_warnings(row, seen, undrawn)
        return row

    def _observation(self, task: ObservationTask) -> Observation:
        folder, shape = Path(task.folder), self.options.learned
        if isinstance(task.content, DataError):
            raise task.content
        if isinstance(task.content, ImageKeypoints):
            seen = self._detected(task.content, folder)
        else:
            seen = self.options.read(parse_json(task.content, task.name), task.name, folder=folder)
        return seen if shape is None else replace(seen, shape=shape.absolute())

    def _detected(self, found: ImageKeypoints, folder: Path) -> Observation:
        detector = self.options.detector
        assert self.model is not None
        photo = None
        if found.image is not None:
            photo = _photo_in(detector.images or folder, found.image)
        with in_file(found.source):
            return observed_in(
                found,
                self.model,
                self.options.changes,
                image=photo,
                min_score=detector.min_score,
                ignore_unknown=detector.ignore_unknown,
            )


def plan_run(options: ManyOptions, folder: RunFolder) -> Plan[ObservationTask]:
    """Plan the estimates of the observations of all inputs.

    Raises CadalignError if an input or the camera cannot be read, or what a detector's file needs
    is missing.
    """
    options.changes.read_camera((1, 1))  # whatever the size: else every row would say its error
    options.check_files()
    tasks = ObservationTasks(options.inputs)
    photos = options.detector.images
    if photos is not None and not photos.is_dir():
        what = f"{photos} is not a folder of photos"
        raise InputError(what, where="images", fix="give the photos' folder, or leave it out")
    model = None
    if tasks.has_detections:
        own = options.detector.model
        model = options.own_keypoints() if own is None else ModelKeypoints.load(own)
    config = options.as_config() | {"contents": tasks.fingerprint()} | options.contents()
    drawn_in = folder.made_for_pictures() if options.pictures else None
    chunk = max(1, min(LARGEST_CHUNK, len(tasks) // _LEAST_CHUNKS))
    estimates = ManyEstimates(absolute_paths(options), model, drawn_in)
    return Plan(estimates, tasks, config, chunk)


_photo_in = lru_cache(maxsize=1024)(photo_in)


def _record(seen: Observation | None, result: Result | None) -> Row:
    """Observation and result as JSON, but for its time, on which no two runs agree."""
    record: Row = {"observation": "", "result": ""}
    if seen is not None:
        record["observation"] = _ENCODER.encode(seen.to_dict()).decode()
    if result is not None:
        data = result.to_dict()
        data["stats"]["seconds"] = 0.0
        record["result"] = _ENCODER.encode(data).decode()
    return record
