"""Files of estimates: a name for each, its poses, and the objects that they are of."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.poses import PoseEstimate, PoseFile
from cadalign.errors import CadalignError, InputError, quote
from cadalign.evaluation.metrics.bop import mssd
from cadalign.evaluation.photos.target import PhotoTarget
from cadalign.geometry.alignment import Alignment

_STEP = 0.1  # of rotations about an axis of symmetry, coarse: it only decides which object is meant


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
