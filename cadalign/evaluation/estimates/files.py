"""Files of estimates: the poses of the models in each photo, and the objects that they are of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.datasets.photos.bop import Bop
from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.photo import Photo
from cadalign.datasets.photos.scan2cad import Scan2CAD
from cadalign.errors import CadalignError, DataError, InputError, quote
from cadalign.evaluation.metrics.bop import mssd
from cadalign.evaluation.photos.target import PhotoTarget
from cadalign.export.bop import read_bop_results, read_scene_gt
from cadalign.export.estimates import Estimates, PoseEstimate
from cadalign.geometry.alignment import Alignment
from cadalign.io.documents import read_json


class EstimateFile(ABC):
    """The poses of one file, by photo.

    Attributes
    ----------
    problems : tuple of DataError
        Why some of its records could not be read.
    """

    problems: tuple[DataError, ...] = ()

    @abstractmethod
    def poses_in(self, photo: Photo) -> tuple[PoseEstimate, ...]:
        """The estimates of a photo's objects, in the unit of the data set."""

    @abstractmethod
    def strays(self, names: Sequence[str]) -> int:
        """Number of estimates, or scans, of photos that are not among these."""


class _BopFile(EstimateFile):
    """BOP's poses, by the numbers of scene and image."""

    def __init__(self, estimates: Estimates, dataset: PhotoDataset) -> None:
        self.problems = estimates.problems
        self._own = str(int(dataset.root.name)) if dataset.root.name.isdecimal() else ""
        scenes = {each.scene for each in estimates.poses}
        is_numbered = self._own or any("/" in name for name in dataset.names)
        if not is_numbered and len(scenes) > 1:
            raise DataError(
                f"poses of {len(scenes)} scenes, but {dataset.root} is a scene without a number",
                where=str(estimates.path),
                fix="give the data set's folder, or a file of that scene alone",
            )
        # A file or a folder that tells no number is of the one scene there is.
        self._any_scene = not is_numbered or scenes == {""}
        self._poses: dict[tuple[str, str], list[PoseEstimate]] = defaultdict(list)
        for each in estimates.poses:
            self._poses["" if self._any_scene else each.scene, each.image].append(each)

    def poses_in(self, photo: Photo) -> tuple[PoseEstimate, ...]:
        return tuple(self._poses.get(self._key(photo.name), ()))

    def strays(self, names: Sequence[str]) -> int:
        known = {self._key(name) for name in names}
        return sum(len(poses) for key, poses in self._poses.items() if key not in known)

    def _key(self, name: str) -> tuple[str, str]:
        scene, _, image = name.rpartition("/")
        scene = scene.rpartition("/")[2]
        number = str(int(scene)) if scene.isdecimal() else self._own
        return "" if self._any_scene else number, str(int(image)) if image.isdecimal() else image


class _Scan2CadFile(EstimateFile):
    """Poses in the form of Scan2CAD's annotations, seen from the frames of the data set."""

    def __init__(self, path: Path, dataset: Scan2CAD) -> None:
        self._photos = dataset.with_annotations(path)
        self.problems = tuple(self._photos.problems.values())
        self._names = set(self._photos.names)

    def poses_in(self, photo: Photo) -> tuple[PoseEstimate, ...]:
        if photo.name not in self._names:
            return ()
        seen = self._photos[photo.name]
        return tuple(
            PoseEstimate("", photo.name, each.model.model_id, each.truth.cam_from_model)
            for each in seen.objects
            if each.model is not None and each.truth.cam_from_model is not None
        )

    def strays(self, names: Sequence[str]) -> int:
        return len(self._names - set(names))


def open_estimates(path: Path, dataset: PhotoDataset) -> EstimateFile:
    """Open a file of estimates on a data set.

    Raises
    ------
    DataError
        If it cannot be read, or is not of a known form.
    InputError
        If it is of another kind of data set.
    """
    is_list = path.suffix.lower() != ".csv" and isinstance(read_json(path), list)
    kind: type[PhotoDataset] = Scan2CAD if is_list else Bop
    if not isinstance(dataset, kind):
        raise InputError(
            f"poses for {kind.kind}, but {dataset.root} holds {dataset.kind}",
            where=str(path),
            fix="give the data set that they are of",
        )
    if isinstance(dataset, Scan2CAD):
        return _Scan2CadFile(path, dataset)
    read = read_bop_results if path.suffix.lower() == ".csv" else read_scene_gt
    return _BopFile(read(path), dataset)


def method_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """A name for each file: its own without the ending, with its folder's where that is needed.

    Raises
    ------
    InputError
        If a file is given twice.
    """
    twice = next((each for row, each in enumerate(paths) if each in paths[:row]), None)
    if twice is not None:
        raise InputError(f"{quote(str(twice))} is given twice", where="estimates")
    general = ("scene_gt", "annotations", "full_annotations")
    names = [
        f"{path.absolute().parent.name}/{path.stem}" if path.stem in general else path.stem
        for path in paths
    ]
    if len(set(names)) < len(names):
        names = [path.with_suffix("").as_posix() for path in paths]
    return tuple(names)


opened_estimates = lru_cache(maxsize=8)(open_estimates)
"""A file of estimates, read once in every process."""


_STEP = 0.1  # of rotations about an axis of symmetry, coarse: it only decides which object is meant


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
