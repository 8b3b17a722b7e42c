"""Assignment of estimates to the objects in a photo."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from cadalign.errors import CadalignError
from cadalign.evaluation.metrics.bop import mssd
from cadalign.evaluation.photos.target import PhotoTarget
from cadalign.export.estimates import PoseEstimate
from cadalign.geometry.alignment import Alignment

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
