"""Errors of estimates of other programs, in the columns of the experiment on photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cadalign.datasets.photos.photo import NamedPoints, Photo
from cadalign.datasets.photos.poses import PoseEstimate
from cadalign.errors import CadalignError, DataError, DegenerateError
from cadalign.evaluation.estimates.files import opened_estimates
from cadalign.evaluation.estimates.matching import match_estimates
from cadalign.evaluation.estimates.options import EstimatesOptions
from cadalign.evaluation.instances.record import RECORD_COLUMNS
from cadalign.evaluation.outcome import LEFT_OUT, Outcome, reason_of
from cadalign.evaluation.photos.drawing import draw_sighting
from cadalign.evaluation.photos.experiment import COLUMNS
from cadalign.evaluation.photos.methods import PhotoEstimate
from cadalign.evaluation.photos.protocols import Protocol, protocol_of
from cadalign.evaluation.photos.records import sighting_record
from cadalign.evaluation.photos.scores import score_alignment
from cadalign.evaluation.photos.sighting import PhotoTarget, Sighting
from cadalign.evaluation.photos.tasks import PhotoTask, opened
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Columns
from cadalign.evaluation.runs.work import AbortError, Rows
from cadalign.geometry.box import Box

_NAMES: Columns = (("category", str), ("model_id", str), ("view", int), ("method", str))
_Answer = tuple[Outcome, PhotoEstimate | CadalignError]
_FACTS = {"source": "", "keypoints": 0}


@dataclass(frozen=True)
class EstimatesExperiment:
    """Scores the estimates of files on the objects of photos.

    Parameters
    ----------
    options : EstimatesOptions
    methods : tuple of str
        A name for each file.
    drawn_in : RunFolder
        The folder that pictures go to.
    """

    columns = COLUMNS
    timing_columns = (*_NAMES, ("seconds", float))
    record_columns = RECORD_COLUMNS

    options: EstimatesOptions
    methods: tuple[str, ...]
    drawn_in: RunFolder = field(repr=False)

    def warm_up(self) -> None:
        """Nothing is compiled here."""

    def evaluate(self, tasks: Sequence[PhotoTask]) -> Rows:
        """Rows and a record for every object of every photo."""
        return Rows.joined([self._rows(task) for task in tasks])

    def failure(self, task: PhotoTask, reason: str) -> Rows:
        """A failed row for every file."""
        return Rows.of(Outcome.failure(reason, task.names(name), **_FACTS) for name in self.methods)

    def _rows(self, task: PhotoTask) -> Rows:
        if task.problem:
            return self.failure(task, task.problem)
        dataset = opened(self.options.root)
        try:
            photo = dataset[task.index]
        except DataError as error:
            return self.failure(task, str(error))
        parts = [
            self.failure(PhotoTask(-1, f"{photo.name}, problem {row + 1}"), str(problem))
            for row, problem in enumerate(photo.problems)
        ]
        targets = [PhotoTarget(photo, found, str(dataset.root)) for found in photo.objects]
        estimates = [self._estimates(index, photo, targets) for index in range(len(self.methods))]
        protocol = protocol_of(dataset.kind)
        for target in targets:
            own = [
                each if isinstance(each, CadalignError) else each.get(target.found.object_id)
                for each in estimates
            ]
            shown = task.index < self.options.pictures
            parts.append(self._object(target, own, protocol, shown=shown))
        return Rows.joined(parts)

    def _estimates(
        self, index: int, photo: Photo, targets: Sequence[PhotoTarget]
    ) -> dict[str, PoseEstimate] | CadalignError:
        """Estimates of a file by the objects' ids, or why it has none of the photo."""
        try:
            file = opened_estimates(self.options.estimates[index], opened(self.options.root))
            return match_estimates(targets, file.poses_in(photo))
        except CadalignError as error:
            return error

    def _object(
        self,
        target: PhotoTarget,
        estimates: Sequence[PoseEstimate | CadalignError | None],
        protocol: Protocol,
        *,
        shown: bool,
    ) -> Rows:
        answers = [
            self._answer(target, name, estimate, protocol)
            for name, estimate in zip(self.methods, estimates, strict=True)
        ]
        outcomes = [outcome for outcome, _ in answers]
        found = [estimate for _, estimate in answers]
        sighting = _sighting(target)
        if sighting is None or not any(outcome.is_ok for outcome in outcomes):
            return Rows.of(outcomes)
        if shown:
            best = next(each for each in found if isinstance(each, PhotoEstimate))
            try:
                draw_sighting(self.drawn_in, sighting, best)
            except OSError as error:
                what = f"a picture cannot be written: {error}"
                fix = "free some space, and start the same command again: the run goes on"
                raise AbortError(what, fix=fix) from None
        return Rows.of(outcomes, [sighting_record(sighting, outcomes, found)])

    def _answer(
        self,
        target: PhotoTarget,
        method: str,
        estimate: PoseEstimate | CadalignError | None,
        protocol: Protocol,
    ) -> _Answer:
        names = target.names(method)
        try:
            bounds = target.bounds
            if target.gt is None or bounds is None:
                why = "the true pose or the size of the model is not known"
                return Outcome(names, dict(_FACTS), LEFT_OUT, why), DegenerateError(why)
            if not isinstance(estimate, PoseEstimate):
                why = "there is no estimate" if estimate is None else str(estimate)
                return Outcome.failure(why, names, **_FACTS), DegenerateError(why)
            pose = estimate.cam_from_model
            found = PhotoEstimate(pose, Box.from_model(bounds, pose))
            scores = score_alignment(target, protocol, pose, found.box)
        except Exception as error:
            why = reason_of(error)
            return Outcome.failure(why, names, **_FACTS), DegenerateError(why)
        return Outcome(names, _FACTS | scores, seconds=estimate.seconds), found


def _sighting(target: PhotoTarget) -> Sighting | None:
    """The object without keypoints, for its picture and its record; None without a camera."""
    camera, bounds = target.camera, target.bounds
    if camera is None or bounds is None or not camera.focal_known:
        return None
    nothing = NamedPoints((), np.empty((0, 3)))
    no_pixels = np.empty((0, 2))
    return Sighting(target, camera, "", (), no_pixels, 1.0, nothing, bounds, 1.0, "y")
