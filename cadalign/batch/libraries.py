"""Runs on libraries of CAD models: building one, and retrieval for many observations.

A library is built of a table with a row for each model of a data set:

category, model_id
    The model.
status, reason
    ``ok``, or ``failed`` and why its annotation cannot be read.
keypoints, mesh
    Number of keypoints, and the file of the mesh; empty where there is none that can be read.
warning
    Why the bounds are the keypoints' instead of the mesh's.

Retrievals are a run of fits: its table, records and exports are those of the best match of each
observation, whose model has these columns besides:

match_category, match_id, match_score
    The model of the library, and its probability; see `cadalign.Match.score`.
match_log_likelihood, none_probability
    As of `cadalign.Match`.
mirrored, missing
    True if the labels are mirrored, and the number of keypoints that the model lacks.
top_categories, top_ids, top_scores
    All matches, the best first.

The records hold all matches as JSON (`cadalign.Match.to_dict`) in the column ``matches``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from cadalign.arrays import worker_count
from cadalign.batch.experiment import Estimated, ManyOptions, plan_run
from cadalign.batch.fits import pool_of
from cadalign.batch.spec import SPEC as FIT_SPEC
from cadalign.batch.spec import summarize_by
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import DataError
from cadalign.estimation.result import Result
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.options import absolute_paths
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.run import OnProgress, execute
from cadalign.evaluation.runs.tables import DONE_ANEW, read_groups
from cadalign.evaluation.runs.work import FAILED, OK, Columns, Plan, Row, Rows, fingerprint
from cadalign.evaluation.summary import median
from cadalign.geometry.alignment import extent
from cadalign.io.documents import in_file
from cadalign.io.files import dense_json
from cadalign.io.observation import Observation
from cadalign.io.observation_file import fill_xyz
from cadalign.retrieval import Library, LibraryModel
from cadalign.retrieval.models import ModelTable, read_annotated, row_of
from cadalign.retrieval.query import ObservationRetrieval

_LARGEST_CHUNK = 64
_EXPERIMENT = "library"
SCORE = Metric("match_score", "score", "%", 0, better="high", factor=100.0, log=False)
NONE = Metric("none_probability", "none of these", "%", 0, factor=100.0, log=False)
_SHOWN = (SCORE, NONE)


class ModelTask(NamedTuple):
    """One model of a data set; None, and why, where its annotation cannot be read."""

    category: str
    model_id: str
    model: AnnotatedModel | None
    reason: str = ""


class ModelRows:
    """Models of a library; see `cadalign.evaluation.runs.work.Experiment`."""

    columns: Columns = (
        *(("category", str), ("model_id", str), ("status", str), ("reason", str)),
        *(("keypoints", int), ("mesh", str), ("warning", str)),
    )
    timing_columns: Columns = (("category", str), ("model_id", str))
    record_columns: Columns = (("model", str),)

    def warm_up(self) -> None:
        """Compile nothing: there are no kernels."""

    def evaluate(self, tasks: Sequence[ModelTask]) -> Rows:
        """The rows of some models."""
        return Rows.joined([self._row(task) for task in tasks])

    def failure(self, task: ModelTask, reason: str) -> Rows:
        """The rows of a model that cannot be read."""
        return _rows(task, {"status": FAILED, "reason": reason}, "")

    def _row(self, task: ModelTask) -> Rows:
        if task.model is None:
            return self.failure(task, task.reason)
        model, warning = read_annotated(task.model)
        found = row_of(model)
        cells = {"status": OK, "reason": "", "keypoints": len(model.xyz), "warning": warning}
        return _rows(task, {**cells, "mesh": found["mesh"]}, json.dumps(found))


def _rows(task: ModelTask, cells: Row, model: str) -> Rows:
    names = {"category": task.category, "model_id": task.model_id}
    return Rows([names | cells], [names], [{"model": model}])


def build_library(
    dataset: KeypointNet,
    folder: Path,
    *,
    workers: int | None = None,
    dask: str | None = None,
    on_progress: OnProgress = lambda progress: None,
) -> tuple[Library, list[Row]]:
    """Build the library of a data set's models, as a run that goes on where it was killed.

    A finished run in the ``folder`` is done anew; further arguments are those of
    `cadalign.fit_many`. Also returns rows of the models that are left out, or whose mesh is. Raises
    DataError if there are no models, or the folder cannot be written or holds something else.
    """
    tasks = [_task(dataset, key) for key in dataset.ids()]
    if not tasks:
        raise DataError("the data set has no such models", where=str(dataset.root))
    run = RunFolder(folder)
    run.refuse_foreign()
    if run.is_finished and (run.read_config() or {}).get("experiment") == _EXPERIMENT:
        run.remove()
    config = {"experiment": _EXPERIMENT, "contents": _contents(tasks)}
    size = max(1, min(_LARGEST_CHUNK, len(tasks) // _LARGEST_CHUNK))
    execute(
        Plan(ModelRows(), tasks, config, size),
        run,
        workers=pool_of(len(tasks), workers, dask),
        on_progress=on_progress,
    )
    records, results = (
        [row for table in read_groups(path, fix=DONE_ANEW) for row in table.to_pylist()]
        for path in (run.records, run.results)
    )
    models = [json.loads(row["model"]) for row in records if row["model"]]
    if not models:
        what, fix = f"none of {len(tasks)} models can be read", f"{run.results} has the reasons"
        raise DataError(what, where=str(dataset.root), fix=fix)
    troubles = [row for row in results if row["reason"] or row["warning"]]
    return Library(ModelTable.of_rows(models)), troubles


def _task(dataset: KeypointNet, key: tuple[str, str]) -> ModelTask:
    try:
        return ModelTask(*key, absolute_paths(dataset[key]))
    except DataError as error:
        return ModelTask(*key, None, str(error))


def _contents(tasks: Sequence[ModelTask]) -> str:
    """A text that changes with the annotations and with the meshes' files."""
    parts: list[Any] = []
    for task in tasks:
        known: list[Any] = [task.category, task.model_id, task.reason]
        if task.model is not None:
            keypoints, path = task.model.keypoints, task.model.mesh_path
            known += [keypoints.ids.tolist(), task.model.symmetries, path]
            parts.append(keypoints.xyz)
            if path is not None and path.is_file():
                known.append(path.stat().st_mtime_ns)
        parts.append(repr(known))
    return fingerprint(*parts)


@dataclass(frozen=True, kw_only=True)
class RetrieveRunOptions(ManyOptions):
    """A run that retrieves the models of many observations; see `ManyOptions`."""

    experiment: ClassVar[str] = "retrieve"
    command: ClassVar[str] = "retrieve"
    columns: ClassVar[Columns] = (
        *(("match_category", str), ("match_id", str), ("match_score", float)),
        *(("match_log_likelihood", float), ("none_probability", float)),
        *(("mirrored", bool), ("missing", int)),
        *(("top_categories", list[str]), ("top_ids", list[str]), ("top_scores", list[float])),
    )
    record_columns: ClassVar[Columns] = (("matches", str),)

    estimate: ObservationRetrieval

    @property
    def threads(self) -> int:
        """The search lets go of the interpreter lock: a run without workers takes all cores."""
        return worker_count(-1)

    @property
    def learned(self) -> Path | None:
        return self.estimate.shape[0] if len(self.estimate.shape) == 1 else None

    def warm_up(self, seen: Observation) -> Result:
        points, ids = seen.points_3d, np.arange(len(seen.points_3d))
        library = Library.from_models([LibraryModel("", "", points, ids, extent(points))])
        return library.retrieve(seen.points_2d, ids, seen.camera, workers=1)[0].result

    def read(self, data: Any, where: str, *, folder: Path) -> Observation:
        with in_file(where):
            seen = Observation.from_dict(fill_xyz(data), folder=folder)
        return self.changes.applied_to(seen, where)

    def estimate_of(self, seen: Observation, where: str) -> Estimated:
        matches = self.estimate.retrieve(seen, where, workers=1)
        best = matches[0]
        cells = {
            "match_category": best.category,
            "match_id": best.model_id,
            "match_score": best.score,
            "match_log_likelihood": best.log_likelihood,
            "none_probability": best.none_probability,
            "mirrored": best.mirrored,
            "missing": len(best.missing_ids),
            "top_categories": [match.category for match in matches],
            "top_ids": [match.model_id for match in matches],
            "top_scores": [match.score for match in matches],
        }
        record = {"matches": dense_json([match.to_dict() for match in matches])}
        return Estimated(best.observation(seen), best.result, cells, record)

    def contents(self) -> dict[str, Any]:
        self.estimate.opened()  # which refuses what cannot be read
        return super().contents()


SPEC = replace(
    FIT_SPEC,
    options=RetrieveRunOptions,
    plan=plan_run,
    columns=(*FIT_SPEC.columns[:3], *_SHOWN, *FIT_SPEC.columns[3:]),
    summarize=summarize_by({metric.key: median(metric.key) for metric in _SHOWN}),
    metrics=(*_SHOWN, *FIT_SPEC.metrics),
    title=lambda runs: "retrieved models",
    about="Red is the best match: its box and model, posed and stretched.",
)
