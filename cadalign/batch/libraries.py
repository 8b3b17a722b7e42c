"""Libraries of CAD models built as a run: a row for each model of a data set, then the library.

category, model_id
    The model.
status, reason
    ``ok``, or ``failed`` and why its annotation cannot be read.
keypoints, mesh
    Number of keypoints, and the file of the mesh; empty where there is none that can be read.
warning
    Why the bounds are the keypoints' instead of the mesh's.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cadalign.batch.fits import pool_of
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.errors import DataError
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.run import OnProgress, execute
from cadalign.evaluation.runs.tables import DONE_ANEW, Columns, Row, read_groups
from cadalign.evaluation.runs.work import FAILED, OK, Plan, Rows, fingerprint
from cadalign.retrieval import Library
from cadalign.retrieval.models import ModelTable, read_annotated, row_of

_LARGEST_CHUNK = 64
_EXPERIMENT = "library"


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
    DataError if there are no models, or the folder cannot be written or holds another run.
    """
    tasks = [_task(dataset, key) for key in dataset.ids()]
    run = RunFolder(folder)
    if run.is_finished and (run.read_config() or {}).get("experiment") == _EXPERIMENT:
        shutil.rmtree(folder)
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
        raise DataError("the data set has no such models", where=str(dataset.root))
    troubles = [row for row in results if row["reason"] or row["warning"]]
    return Library(ModelTable.of_rows(models)), troubles


def _task(dataset: KeypointNet, key: tuple[str, str]) -> ModelTask:
    try:
        return ModelTask(*key, dataset[key])
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
