"""Poses that somebody else estimated, on the objects of photos: methods that read a file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.datasets.photos.dataset import PhotoDataset, PoseEstimate, PoseFile
from cadalign.datasets.photos.photo import NamedPoints
from cadalign.errors import CadalignError, DegenerateError, InputError, quote
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Setting, write_picture
from cadalign.evaluation.experiments.estimates import EstimatesOptions
from cadalign.evaluation.experiments.photos import COLUMNS, summarize_cells
from cadalign.evaluation.instances.record import RECORD_COLUMNS
from cadalign.evaluation.methods.method import Method
from cadalign.evaluation.metrics.bop import mssd
from cadalign.evaluation.metrics.photos import score_alignment
from cadalign.evaluation.photos.methods import PhotoEstimate, Sighting
from cadalign.evaluation.photos.objects import draw_sighting, sighting_record
from cadalign.evaluation.photos.protocols import protocol_of
from cadalign.evaluation.photos.target import PhotoTarget, PhotoTask, opened, targets_of
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import LeftOutError, Outcome, Row
from cadalign.evaluation.summary import Summary
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box

Poses = Mapping[tuple[str, str], Alignment]
"""Alignments by the photo's name and the object's id."""
_FACTS = {"source": "", "keypoints": 0}
_STEP = 0.1  # of rotations about an axis of symmetry, coarse: it only decides which object is meant


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """An object of a photo, and each method's pose of it, or why it has none."""

    target: PhotoTarget
    poses: tuple[PoseEstimate | CadalignError | None, ...]


@dataclass(frozen=True)
class PosesOfObjects(Setting):
    """Objects of photos with given poses; they are tasks and instances at once."""

    names = VIEW_NAMES
    columns = COLUMNS

    kind: str  # of the data set

    def case(self, task: GivenPoses) -> Case:
        return Case(task.target.names, _FACTS, task)

    def row(self, method: Method, instance: GivenPoses, estimate: PhotoEstimate) -> Row:
        sets = protocol_of(self.kind).metrics
        return score_alignment(instance.target, sets, estimate.alignment, estimate.box)


@dataclass(frozen=True)
class PosesOfFiles(PosesOfObjects):
    """Poses of files on the objects of photos: the setting of the experiment."""

    record_columns = RECORD_COLUMNS

    options: EstimatesOptions
    drawn_in: RunFolder = field(repr=False)  # the folder that pictures go to

    def failed(self, task: PhotoTask) -> list[Case]:
        return [Case(task.names, _FACTS)]

    def _cases(self, task: PhotoTask) -> list[Case]:
        found = targets_of(task, self.options.root, pictures=self.options.pictures)
        targets = [each for each in found if isinstance(each, PhotoTarget)]
        files = [self._poses(path, targets) for path in self.options.estimates if targets]
        cases = []
        for each in found:
            if isinstance(each, Case):
                cases.append(replace(each, facts=_FACTS))
                continue
            poses = tuple(
                some if isinstance(some, CadalignError) else some.get(each.found.object_id)
                for some in files
            )
            cases.append(self.case(GivenPoses(each, poses)))
        return cases

    def _poses(
        self, path: Path, targets: Sequence[PhotoTarget]
    ) -> dict[str, PoseEstimate] | CadalignError:
        """Poses of a file by the objects' ids, or why it has none of the photo."""
        try:
            file = opened_estimates(path, opened(self.options.root))
            return match_estimates(targets, file.poses_in(targets[0].photo))
        except CadalignError as error:
            return error

    def finish(
        self, case: Case, outcomes: list[Outcome], estimates: list[Any]
    ) -> tuple[list[Outcome], Row | None]:
        instance: GivenPoses = case.instance
        outcomes = [
            replace(outcome, seconds=pose.seconds if isinstance(pose, PoseEstimate) else None)
            for outcome, pose in zip(outcomes, instance.poses, strict=True)
        ]
        sighting = self._sighting(instance.target)
        if sighting is None or not any(outcome.is_ok for outcome in outcomes):
            return outcomes, None
        if instance.target.is_shown:
            best = next(each for each in estimates if isinstance(each, PhotoEstimate))
            write_picture(draw_sighting, self.drawn_in, sighting, best)
        return outcomes, sighting_record(sighting, outcomes, estimates)

    def _sighting(self, target: PhotoTarget) -> Sighting | None:
        """The object without keypoints, for picture and record; None without a camera."""
        camera, bounds = target.camera, target.bounds
        if camera is None or bounds is None or not camera.focal_known:
            return None
        nothing, none = NamedPoints((), np.empty((0, 3))), np.empty((0, 2))
        protocol = protocol_of(self.kind)
        return Sighting(target, camera, "", (), none, 1.0, nothing, bounds, 1.0, protocol)


def estimates_benchmark(
    kind: str, options: EstimatesOptions, names: Sequence[str], drawn_in: RunFolder
) -> Benchmark:
    """Files of estimates, by these names, on the objects of photos of a data set of a kind."""
    return Benchmark(PosesOfFiles(kind, options, drawn_in), _methods(names))


def score_poses(dataset: PhotoDataset, poses: Poses, *, method: str = "given") -> list[Row]:
    """Score given poses of the objects of a data set, by its own metrics.

    Parameters
    ----------
    dataset : PhotoDataset
        See `cadalign.datasets.open`.
    poses : mapping of (str, str) to Alignment
        By `Photo.name` and `PhotoObject.object_id`: pose and stretch of the data set's model in the
        frame and the unit of the photo's camera. Objects without one count as failed.
    method : str
        A name for the rows.

    Returns
    -------
    list of dict
        A row for each object with a true pose; see docs/formats/runs.md for its columns.

    Raises
    ------
    InputError
        If a pose is of a photo or an object that the data set lacks.

    Examples
    --------
    >>> import cadalign
    >>> dataset = cadalign.datasets.open("lmo")  # doctest: +SKIP
    >>> truth = {(photo.name, found.object_id): found.truth.cam_from_model
    ...          for photo in dataset for found in photo.objects}  # doctest: +SKIP
    >>> score_poses(dataset, truth)[0]["mssd"]  # doctest: +SKIP
    0.0
    """
    tasks, left = [], set(poses)
    for photo in dataset:
        for found in photo.objects:
            if found.truth.cam_from_model is None and found.truth.box is None:
                continue
            key = photo.name, found.object_id
            left.discard(key)
            est, model_id = poses.get(key), "" if found.model is None else found.model.model_id
            pose = None if est is None else PoseEstimate("", photo.name, model_id, est, 1.0)
            tasks.append(GivenPoses(PhotoTarget(photo, found, str(dataset.root)), (pose,)))
    if left:
        name, object_id = sorted(left)[0]
        what = f"the data set has no object {quote(object_id)} with a pose in the photo "
        raise InputError(f"{what}{quote(name)}", where="poses")
    return Benchmark(PosesOfObjects(dataset.kind), _methods([method])).evaluate(tasks).rows


def summarize_rows(rows: list[Row]) -> list[Summary]:
    """Summaries of rows by category and method; see `cadalign.evaluation.experiments.photos`."""
    names = (*(name for name, _ in COLUMNS), "seconds")
    cells = {name: np.array([row.get(name) for row in rows], dtype=object) for name in names}
    return summarize_cells(cells, list(dict.fromkeys(row["method"] for row in rows)))


def _methods(names: Sequence[str]) -> tuple[Method, ...]:
    return tuple(Method(name, partial(_pose, index=k)) for k, name in enumerate(names))


def _pose(instance: GivenPoses, *, index: int) -> PhotoEstimate:
    target, pose = instance.target, instance.poses[index]
    bounds = target.bounds
    if target.gt is None or bounds is None:
        raise LeftOutError("the true pose or the size of the model is not known")
    if not isinstance(pose, PoseEstimate):
        raise DegenerateError("there is no estimate") if pose is None else pose
    return PhotoEstimate(pose.cam_from_model, Box.from_model(bounds, pose.cam_from_model))


# Files --------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def opened_estimates(path: Path, dataset: PhotoDataset) -> PoseFile:
    """Open a file of estimates on a data set, once in every process."""
    return dataset.open_poses(path)


def match_estimates(
    targets: Sequence[PhotoTarget], poses: Sequence[PoseEstimate]
) -> dict[str, PoseEstimate]:
    """The estimate of each object, by the object's id.

    As in BOP's localisation task, a photo's n objects of one model are matched with the n estimates
    of the highest scores; the others are not counted. The best estimate takes the object that it is
    nearest to, by the symmetry-aware distance of surfaces, and so on.
    """
    of_model: dict[str, list[PhotoTarget]] = defaultdict(list)
    for target in targets:
        if target.found.model is not None:
            of_model[target.found.model.model_id].append(target)
    found: dict[str, PoseEstimate] = {}
    for model_id, left in of_model.items():
        own = [each for each in poses if each.model_id == model_id]
        for pose in sorted(own, key=lambda each: -each.score)[: len(left)]:
            nearest = min(left, key=lambda target: _distance(target, pose.cam_from_model))
            left.remove(nearest)
            found[nearest.found.object_id] = pose
    return found


def _distance(target: PhotoTarget, est: Alignment) -> float:
    gt, cad = target.gt, target.cad
    if gt is None:
        return float("inf")
    try:
        if cad is not None and cad.has_mesh:
            symmetry = target.found.symmetry
            vertices = cad.hull_vertices
            return mssd(est=est, gt=gt, vertices=vertices, symmetry=symmetry, max_step=_STEP)
    except CadalignError:
        pass
    return float(np.linalg.norm(est.translation - gt.translation))
