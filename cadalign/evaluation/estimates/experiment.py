"""Errors of estimates of other programs, in the columns of the experiment on photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from cadalign.datasets.photos.photo import NamedPoints
from cadalign.datasets.photos.poses import PoseEstimate
from cadalign.errors import CadalignError, DegenerateError
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Pair, Setting, attempt
from cadalign.evaluation.estimates.files import match_estimates, opened_estimates
from cadalign.evaluation.estimates.options import EstimatesOptions
from cadalign.evaluation.instances.record import RECORD_COLUMNS
from cadalign.evaluation.methods.method import Method
from cadalign.evaluation.metrics.sets import score_alignment
from cadalign.evaluation.outcome import LeftOutError, Outcome
from cadalign.evaluation.photos.experiment import COLUMNS, draw, targets_of
from cadalign.evaluation.photos.methods import PhotoEstimate
from cadalign.evaluation.photos.protocols import Protocol, protocol_of
from cadalign.evaluation.photos.records import sighting_record
from cadalign.evaluation.photos.sighting import Sighting
from cadalign.evaluation.photos.target import PhotoTarget
from cadalign.evaluation.photos.tasks import PhotoTask, opened
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Row
from cadalign.geometry.box import Box

_FACTS = {"source": "", "keypoints": 0}


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """An object of a photo, and each file's estimate of it, or why it has none."""

    target: PhotoTarget
    protocol: Protocol
    poses: tuple[PoseEstimate | CadalignError | None, ...]
    is_shown: bool


@dataclass(frozen=True)
class PosesOfFiles(Setting):
    """Estimates of files on the objects of photos: the setting of the experiment.

    Parameters
    ----------
    options : EstimatesOptions
    drawn_in : RunFolder
        The folder that pictures go to.
    """

    names = VIEW_NAMES
    columns = COLUMNS
    record_columns = RECORD_COLUMNS

    options: EstimatesOptions
    drawn_in: RunFolder = field(repr=False)

    def warm_up(self) -> Sequence[PhotoTask]:
        """Nothing is compiled here."""
        return ()

    def cases(self, tasks: Sequence[PhotoTask]) -> list[Case]:
        """The objects of every photo, with their estimates."""
        return [case for task in tasks for case in self._cases(task)]

    def failed(self, task: PhotoTask) -> list[Case]:
        """The case of a photo that cannot be scored."""
        return [Case(task.names, _FACTS)]

    def _cases(self, task: PhotoTask) -> list[Case]:
        found = targets_of(task, self.options.root)
        targets = [each for each in found if isinstance(each, PhotoTarget)]
        files = range(len(self.options.estimates))
        poses = [self._poses(index, targets) for index in files] if targets else []
        protocol = protocol_of(opened(self.options.root).kind) if targets else None
        shown = task.index < self.options.pictures
        cases = []
        for each in found:
            if isinstance(each, Case):
                cases.append(replace(each, facts=_FACTS))
                continue
            own = tuple(
                some if isinstance(some, CadalignError) else some.get(each.found.object_id)
                for some in poses
            )
            assert protocol is not None
            cases.append(Case(each.names, _FACTS, GivenPoses(each, protocol, own, shown)))
        return cases

    def _poses(
        self, index: int, targets: Sequence[PhotoTarget]
    ) -> dict[str, PoseEstimate] | CadalignError:
        """Poses of a file by the objects' ids, or why it has none of the photo."""
        try:
            file = opened_estimates(self.options.estimates[index], opened(self.options.root))
            return match_estimates(targets, file.poses_in(targets[0].photo))
        except CadalignError as error:
            return error

    def measure(self, method: Method, pairs: Sequence[Pair]) -> list[Row | Exception]:
        """Errors by the metrics of the data set."""
        return [
            attempt(score_alignment, each.target, each.protocol.metrics, found.alignment, found.box)
            for each, found in pairs
        ]

    def finish(
        self, case: Case, outcomes: list[Outcome], estimates: list[Any]
    ) -> tuple[list[Outcome], Row | None]:
        """The outcomes with their files' times, the record and the pictures of an object."""
        instance: GivenPoses = case.instance
        outcomes = [
            replace(outcome, seconds=pose.seconds if isinstance(pose, PoseEstimate) else None)
            for outcome, pose in zip(outcomes, instance.poses, strict=True)
        ]
        sighting = _sighting(instance.target)
        if sighting is None or not any(outcome.is_ok for outcome in outcomes):
            return outcomes, None
        if instance.is_shown:
            best = next(each for each in estimates if isinstance(each, PhotoEstimate))
            draw(self.drawn_in, sighting, best)
        return outcomes, sighting_record(sighting, outcomes, estimates)


def estimates_benchmark(
    options: EstimatesOptions, names: Sequence[str], drawn_in: RunFolder
) -> Benchmark:
    """Files of estimates, by these names, on the objects of photos."""
    methods = tuple(Method(name, partial(_pose, index=k)) for k, name in enumerate(names))
    return Benchmark(PosesOfFiles(options, drawn_in), methods)


def _pose(instance: GivenPoses, *, index: int) -> PhotoEstimate:
    """The pose that a file has of an object."""
    target, pose = instance.target, instance.poses[index]
    bounds = target.bounds
    if target.gt is None or bounds is None:
        raise LeftOutError("the true pose or the size of the model is not known")
    if not isinstance(pose, PoseEstimate):
        raise DegenerateError("there is no estimate") if pose is None else pose
    return PhotoEstimate(pose.cam_from_model, Box.from_model(bounds, pose.cam_from_model))


def _sighting(target: PhotoTarget) -> Sighting | None:
    """The object without keypoints, for its picture and its record; None without a camera."""
    camera, bounds = target.camera, target.bounds
    if camera is None or bounds is None or not camera.focal_known:
        return None
    nothing = NamedPoints((), np.empty((0, 3)))
    no_pixels = np.empty((0, 2))
    return Sighting(target, camera, "", (), no_pixels, 1.0, nothing, bounds, 1.0, "y")
