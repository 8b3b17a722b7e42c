"""The sparse-keypoint experiment on KeypointNet: every model, every method, any number of views."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.alignment import Alignment
from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.hull import KeypointHull
from cadalign.evaluation.instance import Instance, make_hull_instance, make_instance
from cadalign.evaluation.keypoint_tasks import KeypointTask
from cadalign.evaluation.limits import limit_estimate
from cadalign.evaluation.methods import LIMIT, fit_batch_with
from cadalign.evaluation.outcome import Outcome
from cadalign.evaluation.symmetry import SymmetryGroup
from cadalign.evaluation.work import AbortError, Columns, Result, reason_of
from cadalign.validation import FloatArray

if TYPE_CHECKING:
    from cadalign.render import Scene

_TIMING = ("category", "model_id", "view", "method", "seconds")
_TYPES: dict[str, type] = {"int": int, "float": float, "str": str}


@dataclass(frozen=True)
class KeypointNetExperiment:
    """Evaluates methods on views of annotated models.

    Parameters
    ----------
    methods : tuple of str
        Names in `cadalign.evaluation.methods.method_names`.
    noise_px : float
        Standard deviation of the keypoints' noise [px].
    min_visible : int
        How many keypoints a view must show.
    seed : int
    overlays : Path, optional
        An existing folder; the first method's alignment of every instance with a mesh is drawn
        there.
    """

    methods: tuple[str, ...]
    noise_px: float = 1.0
    min_visible: int = 6
    seed: int = 0
    overlays: Path | None = None

    @property
    def columns(self) -> Columns:
        """The columns of the result table; see `Outcome`."""
        return _columns_of(Outcome.columns())

    @property
    def timing_columns(self) -> Columns:
        """The instance, the method, and its share of the seconds that its chunk took."""
        return _columns_of(list(_TIMING))

    def warm_up(self) -> None:
        """Compile solvers and metrics."""
        rng = np.random.default_rng(0)
        task = KeypointTask(
            category="warm-up",
            model_id="",
            view=0,
            xyz=rng.uniform(-0.3, 0.3, (12, 3)),
            semantic_ids=np.arange(12),
            symmetry=SymmetryGroup(np.zeros(3), np.eye(3)[None]),
        )
        self.evaluate([task])

    def evaluate(self, tasks: Sequence[KeypointTask]) -> Result:
        """A row for every task and method."""
        outcomes = self.outcomes(tasks)
        return Result([row.row() for row in outcomes], [row.timing() for row in outcomes])

    def failure(self, task: KeypointTask, reason: str) -> Result:
        """A failed row for every method."""
        outcomes = [self._failure(task, method, reason) for method in self.methods]
        return Result([row.row() for row in outcomes], [row.timing() for row in outcomes])

    def outcomes(self, tasks: Sequence[KeypointTask]) -> list[Outcome]:
        """The same as `evaluate`, not yet as rows of a table."""
        made = _Instances(self)
        instances: list[Instance | str] = []
        seconds = []
        for task in tasks:
            start = time.perf_counter()
            try:
                instances.append(made.instance(task))
            except Exception as error:
                instances.append(reason_of(error))
            seconds.append(time.perf_counter() - start)
        table: list[list[Outcome]] = [[] for _ in tasks]
        for method in self.methods:
            for rows, row in zip(table, self._run(method, tasks, instances), strict=True):
                rows.append(row)
        # The first method's row bears the time of making the instance.
        return [
            row if place else _with_seconds(row, row.seconds + extra)
            for rows, extra in zip(table, seconds, strict=True)
            for place, row in enumerate(rows)
        ]

    def _run(
        self, method: str, tasks: Sequence[KeypointTask], instances: Sequence[Instance | str]
    ) -> list[Outcome]:
        """One method's outcome for every task."""
        usable = [instance for instance in instances if isinstance(instance, Instance)]
        start = time.perf_counter()
        estimates = iter(self._estimates(method, usable))
        share = (time.perf_counter() - start) / max(len(usable), 1)
        outcomes = []
        for task, instance in zip(tasks, instances, strict=True):
            if isinstance(instance, str):
                outcomes.append(self._failure(task, method, instance))
                continue
            start = time.perf_counter()
            try:
                outcome = self._outcome(task, instance, method, next(estimates))
            except AbortError:
                raise
            except Exception as error:
                outcome = self._failure(task, method, reason_of(error), instance)
            outcomes.append(_with_seconds(outcome, share + time.perf_counter() - start))
        return outcomes

    def _estimates(
        self, method: str, instances: Sequence[Instance]
    ) -> list[Alignment | CadalignError]:
        """What a method makes of every instance."""
        estimates: list[Alignment | CadalignError] = []
        if method == LIMIT:
            for instance in instances:
                try:
                    estimates.append(
                        limit_estimate(
                            instance.points_3d, instance.points_2d, instance.camera, instance.gt
                        )
                    )
                except CadalignError as error:
                    estimates.append(error)
            return estimates
        if not instances:
            return estimates
        batch = fit_batch_with(
            method,
            [instance.points_3d for instance in instances],
            [instance.points_2d for instance in instances],
            [instance.camera for instance in instances],
            sigma=self.noise_px or 1.0,
        )
        return [
            batch.errors[b] if b in batch.errors else batch.alignment(b) for b in range(len(batch))
        ]

    def _outcome(
        self,
        task: KeypointTask,
        instance: Instance,
        method: str,
        estimate: Alignment | CadalignError,
    ) -> Outcome:
        if isinstance(estimate, CadalignError):
            return self._failure(task, method, str(estimate), instance)
        residuals = _projected(instance, estimate) - instance.points_2d
        if self.overlays is not None and instance.scene is not None and method == self.methods[0]:
            _draw(self.overlays / overlay_name(*_names(task)), instance, estimate)
        return Outcome.of_alignment(
            estimate,
            gt=instance.gt,
            bounds=instance.bounds,
            symmetry=task.symmetry,
            rms_px=float(np.sqrt((residuals**2).sum(axis=1).mean())),
            category=task.category,
            model_id=task.model_id,
            view=task.view,
            method=method,
            visibility=instance.visibility,
            keypoints=len(instance.points_3d),
            seconds=0.0,
        )

    def _failure(
        self, task: KeypointTask, method: str, reason: str, instance: Instance | None = None
    ) -> Outcome:
        known = (
            {}
            if instance is None
            else {
                "visibility": instance.visibility,
                "keypoints": len(instance.points_3d),
            }
        )
        return Outcome.of_failure(
            reason,
            category=task.category,
            model_id=task.model_id,
            view=task.view,
            method=method,
            symmetry="" if task.problem else str(task.symmetry),
            **known,
        )


def overlay_name(category: str, model_id: str, view: int = 0) -> str:
    """The file name of an instance's overlay."""
    return f"{category}_{model_id}.png" if view == 0 else f"{category}_{model_id}_{view}.png"


class _Instances:
    """Makes the instances of a chunk; what views of one model share is made once."""

    def __init__(self, experiment: KeypointNetExperiment) -> None:
        self._experiment = experiment
        self._model: tuple[str, str] | None = None
        self._hull = KeypointHull(np.empty((0, 3)))
        self._scene: Scene | None = None

    def instance(self, task: KeypointTask) -> Instance:
        """The instance of a task.

        Raises
        ------
        CadalignError
            If there is none.
        """
        if task.problem:
            raise DataError(task.problem)
        experiment = self._experiment
        if self._model != (task.category, task.model_id):
            self._model, self._scene = (task.category, task.model_id), None
            self._hull = KeypointHull(task.xyz)
        if task.model is None:
            return make_hull_instance(
                self._hull,
                task.semantic_ids,
                names=(task.category, task.model_id),
                noise_px=experiment.noise_px,
                min_visible=experiment.min_visible,
                seed=experiment.seed,
                view_index=task.view,
            )
        from cadalign.evaluation.instance import load_scene

        self._scene = self._scene or load_scene(task.model)
        return make_instance(
            task.model,
            noise_px=experiment.noise_px,
            min_visible=experiment.min_visible,
            seed=experiment.seed,
            view_index=task.view,
            scene=self._scene,
        )


def _projected(instance: Instance, estimate: Alignment) -> FloatArray:
    """Where an estimate puts the keypoints [px]; also behind the camera, for the limit's sake."""
    points = (instance.points_3d @ estimate.linear.T) + estimate.translation
    return instance.camera.pixels_from_normalized(points[:, :2] / points[:, 2:])


def _draw(path: Path, instance: Instance, estimate: Alignment) -> None:
    from cadalign.evaluation.drawing import draw_instance

    assert instance.scene is not None
    try:
        draw_instance(path, instance, estimate)
    except (OSError, DataError) as error:
        raise AbortError(
            f"the overlay cannot be written: {error}",
            fix="free some space, and start the same command again: the run goes on",
        ) from None


def _names(task: KeypointTask) -> tuple[str, str, int]:
    return task.category, task.model_id, task.view


def _with_seconds(outcome: Outcome, seconds: float) -> Outcome:
    object.__setattr__(outcome, "seconds", seconds)  # fresh, and seen by nobody yet
    return outcome


def _columns_of(names: Sequence[str]) -> Columns:
    kinds = {field.name: str(field.type).split(" ")[0] for field in fields(Outcome)}
    return tuple((name, _TYPES[kinds[name]]) for name in names)
