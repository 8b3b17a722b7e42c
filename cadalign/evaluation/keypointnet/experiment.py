"""The sparse-keypoint experiment on KeypointNet: every model, every method, any number of views."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DataError
from cadalign.evaluation.accuracy.cramer_rao import limit_estimate
from cadalign.evaluation.accuracy.methods import LIMIT, fit_batch_with, fit_with, has_statistics
from cadalign.evaluation.accuracy.outcome import Outcome
from cadalign.evaluation.instances.hull import KeypointHull
from cadalign.evaluation.instances.instance import Instance, make_hull_instance, make_instance
from cadalign.evaluation.instances.record import EXHIBIT_COLUMNS, Estimate, exhibit_row
from cadalign.evaluation.instances.symmetry import SymmetryGroup
from cadalign.evaluation.keypointnet.tasks import KeypointTask
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import AbortError, Columns, Result, Row, reason_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.projection import perspective

if TYPE_CHECKING:
    from cadalign.render import Scene

_TIMING = ("category", "model_id", "view", "method", "seconds")
_TYPES: dict[str, type] = {"int": int, "float": float, "str": str}


@dataclass(frozen=True, eq=False)
class Trial:
    """What became of one view of one model.

    Parameters
    ----------
    instance : Instance or str
        Or why there is none.
    outcomes : list of Outcome
        One for each method.
    estimates : list of Estimate or CadalignError
        What these are the outcomes of; empty where there is no instance.
    """

    instance: Instance | str
    outcomes: list[Outcome]
    estimates: list[Estimate | CadalignError]

    @property
    def exhibits(self) -> list[Row]:
        """Its row in the table of exhibits, if there is an instance to show."""
        if isinstance(self.instance, str):
            return []
        return [exhibit_row(self.instance, self.outcomes, self.estimates)]


@dataclass(frozen=True)
class KeypointNetExperiment:
    """Evaluates methods on views of annotated models.

    Parameters
    ----------
    methods : tuple of str
        Names in `cadalign.evaluation.accuracy.methods.method_names`.
    noise_px : float
        Standard deviation of the keypoints' noise [px].
    min_visible : int
        How many keypoints a view must show.
    seed : int
    drawn_in : RunFolder, optional
        Where the first method's alignment of every instance with a mesh is drawn; its folders
        `overlays`, `thumbs`, `pictures` and `sketches` must exist.
    """

    methods: tuple[str, ...]
    noise_px: float = 1.0
    min_visible: int = 6
    seed: int = 0
    drawn_in: RunFolder | None = None

    @property
    def columns(self) -> Columns:
        """The columns of the result table; see `Outcome`."""
        return _columns_of(Outcome.columns())

    @property
    def timing_columns(self) -> Columns:
        """The instance, the method, and its share of the seconds that its chunk took."""
        return _columns_of(list(_TIMING))

    @property
    def exhibit_columns(self) -> Columns:
        """Columns of the instance records; see `evaluation/instances/record.py`."""
        return EXHIBIT_COLUMNS

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
        trials = self.trials(tasks)
        outcomes = [outcome for trial in trials for outcome in trial.outcomes]
        return Result(
            [outcome.row() for outcome in outcomes],
            [outcome.timing() for outcome in outcomes],
            [row for trial in trials for row in trial.exhibits],
        )

    def failure(self, task: KeypointTask, reason: str) -> Result:
        """A failed row for every method."""
        outcomes = [self._failure(task, method, reason) for method in self.methods]
        return Result([row.row() for row in outcomes], [row.timing() for row in outcomes])

    def trials(self, tasks: Sequence[KeypointTask]) -> list[Trial]:
        """The same as `evaluate`, not yet as rows of tables."""
        made = _Instances(self)
        trials = []
        seconds = []
        for task in tasks:
            start = time.perf_counter()
            try:
                trials.append(Trial(made.instance(task), [], []))
            except Exception as error:
                trials.append(Trial(reason_of(error), [], []))
            seconds.append(time.perf_counter() - start)
        for method in self.methods:
            self._run(method, tasks, trials)
        # The first method's row bears the time of making the instance.
        for trial, extra in zip(trials, seconds, strict=True):
            _add_seconds(trial.outcomes[0], extra)
        return trials

    def _run(self, method: str, tasks: Sequence[KeypointTask], trials: Sequence[Trial]) -> None:
        """Add one method's estimate and outcome to every trial."""
        usable = [trial.instance for trial in trials if isinstance(trial.instance, Instance)]
        start = time.perf_counter()
        estimates = iter(self._estimates(method, usable))
        share = (time.perf_counter() - start) / max(len(usable), 1)
        for task, trial in zip(tasks, trials, strict=True):
            if isinstance(trial.instance, str):
                trial.outcomes.append(self._failure(task, method, trial.instance))
                continue
            start = time.perf_counter()
            estimate = next(estimates)
            try:
                outcome = self._outcome(task, trial.instance, method, estimate)
            except AbortError:
                raise
            except Exception as error:
                outcome = self._failure(task, method, reason_of(error), trial.instance)
            _add_seconds(outcome, share + time.perf_counter() - start)
            trial.outcomes.append(outcome)
            trial.estimates.append(estimate)

    def _estimates(
        self, method: str, instances: Sequence[Instance]
    ) -> list[Estimate | CadalignError]:
        """What a method makes of every instance."""
        if method == LIMIT or has_statistics(method):
            return [self._estimate(method, instance) for instance in instances]
        if not instances:
            return []
        batch = fit_batch_with(
            method,
            [instance.points_3d for instance in instances],
            [instance.points_2d for instance in instances],
            [instance.camera for instance in instances],
            sigma=self.noise_px or 1.0,
        )
        return [
            batch.errors[b] if b in batch.errors else Estimate(batch.alignment(b))
            for b in range(len(batch))
        ]

    def _estimate(self, method: str, instance: Instance) -> Estimate | CadalignError:
        """What the limit, or a method that tells more than an alignment, makes of an instance."""
        given = instance.points_3d, instance.points_2d, instance.camera
        try:
            if method == LIMIT:
                return Estimate(limit_estimate(*given, instance.gt))
            return Estimate.of_fit(fit_with(method, *given, sigma=self.noise_px or 1.0))
        except CadalignError as error:
            return error

    def _outcome(
        self,
        task: KeypointTask,
        instance: Instance,
        method: str,
        estimate: Estimate | CadalignError,
    ) -> Outcome:
        if isinstance(estimate, CadalignError):
            return self._failure(task, method, str(estimate), instance)
        alignment = estimate.alignment
        residuals = _projected(instance, alignment) - instance.points_2d
        if self.drawn_in is not None and instance.scene is not None and method == self.methods[0]:
            _draw(self.drawn_in, task, instance, alignment)
        return Outcome.of_alignment(
            alignment,
            gt=instance.gt,
            gt_box=instance.gt_box,
            bounds=instance.bounds,
            symmetry=task.symmetry,
            rms_px=float(np.sqrt((residuals**2).sum(axis=1).mean())),
            category=task.category,
            model_id=task.model_id,
            view=task.view,
            method=method,
            seconds=0.0,
            **_known(instance),
        )

    def _failure(
        self, task: KeypointTask, method: str, reason: str, instance: Instance | None = None
    ) -> Outcome:
        return Outcome.of_failure(
            reason,
            category=task.category,
            model_id=task.model_id,
            view=task.view,
            method=method,
            symmetry="" if task.problem else str(task.symmetry),
            **({} if instance is None else _known(instance)),
        )


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
        from cadalign.evaluation.instances.instance import load_scene

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
    return instance.camera.pixels_from_normalized(perspective(points))


def _known(instance: Instance) -> dict[str, Any]:
    """What an outcome says of its instance."""
    _, stretch_y, stretch_z = (1 / instance.gt.scale).tolist()
    return {
        "visibility": instance.visibility,
        "keypoints": len(instance.points_3d),
        "stretch_y": stretch_y,
        "stretch_z": stretch_z,
    }


def _draw(folder: RunFolder, task: KeypointTask, instance: Instance, estimate: Alignment) -> None:
    from cadalign.evaluation.instances.drawing import draw_instance

    try:
        draw_instance(
            folder,
            instance,
            estimate,
            category=task.category,
            model_id=task.model_id,
            view=task.view,
        )
    except (OSError, DataError) as error:
        raise AbortError(
            f"the overlay cannot be written: {error}",
            fix="free some space, and start the same command again: the run goes on",
        ) from None


def _add_seconds(outcome: Outcome, seconds: float) -> None:
    object.__setattr__(outcome, "seconds", outcome.seconds + seconds)  # fresh, seen by nobody yet


def _columns_of(names: Sequence[str]) -> Columns:
    kinds = {field.name: str(field.type).split(" ")[0] for field in fields(Outcome)}
    return tuple((name, _TYPES[kinds[name]]) for name in names)
