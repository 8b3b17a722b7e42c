"""From views to the evidence that the kernels take."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.fitting.joint.prior import ShapePrior
from cadalign.fitting.joint.view import View
from cadalign.fitting.noise import rays_of, whitening_of
from cadalign.solvers.joint.evidence import (
    Directions,
    Evidence,
    Lengths,
    Rig,
    ScalePriors,
    Sightings,
)

_NO_RIG = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
_NO_LENGTHS = Lengths(
    np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)
)
_COMMON_SCALE_SIGMA = 3.0  # of the log of a size that views or depth determine
_SAME_SCALE_SIGMA = 1e-4


def evidence_of(
    prior: ShapePrior,
    views: Sequence[View],
    *,
    loss: int,
    loss_scale: float,
) -> Evidence:
    """All that the views and the first component of the prior tell.

    Raises
    ------
    InputError
        If a view names a keypoint that the model lacks, or only some views have a known pose.
    """
    return Evidence(
        prior.components[0],
        _sightings(prior, views, loss, loss_scale),
        _rig(views),
        _directions(prior, views),
        _NO_LENGTHS,
        _scales(prior, views),
    )


def is_metric(views: Sequence[View]) -> bool:
    """True if the views tell the object's size: by depth, or by several known camera poses."""
    depths = [cast(FloatArray, view.depth) for view in views if view.depth is not None]
    if any(np.isfinite(depth).any() for depth in depths):
        return True
    return len(views) > 1 and views[0].cam_from_rig is not None


def _scales(prior: ShapePrior, views: Sequence[View]) -> ScalePriors:
    """Free the size where the views tell it."""
    if not is_metric(views):
        return prior.scales
    if prior.scales.free.sum() == 2 and not prior.scales.precision.any():
        return ScalePriors(np.ones(3), np.zeros((3, 3)))
    mean = np.ones((3, 3)) / 3
    common = mean / (3 * _COMMON_SCALE_SIGMA**2)
    tied = (np.eye(3) - mean) / _SAME_SCALE_SIGMA**2
    if prior.scales.free.any():
        tied = (np.eye(3) - mean) * prior.scales.precision.max()
    return ScalePriors(np.ones(3), common + tied)


def _sightings(prior: ShapePrior, views: Sequence[View], loss: int, loss_scale: float) -> Sightings:
    points, images, rays, whitenings, depths = [], [], [], [], []
    for number, view in enumerate(views):
        pixels = cast(FloatArray, view.points_2d)
        rows = prior.rows_of(view.keypoint_ids, f"views[{number}].ids")
        points.append(np.array(rows, dtype=np.int64))
        images.append(np.full(len(rows), number))
        seen = rays_of(np.require(pixels, requirements="W"), view.camera)
        rays.append(seen)
        whitenings.append(
            np.broadcast_to(whitening_of(view.sigma, seen, view.camera), (len(rows), 3))
        )
        depths.append(_depths(view, len(rows)))
    point = np.concatenate(points)
    order = np.argsort(point, kind="stable")
    return Sightings(
        point[order],
        np.concatenate(images)[order],
        np.concatenate(rays)[order],
        np.concatenate(whitenings)[order],
        np.concatenate(depths)[order],
        np.full(len(point), loss),
        np.full(len(point), float(loss_scale)),
    )


def _depths(view: View, count: int) -> FloatArray:
    """Depths (n, 2) and their inverse standard deviations, 0 where unknown."""
    found = np.zeros((count, 2))
    if view.depth is not None:
        depth = cast(FloatArray, view.depth)
        known = np.isfinite(depth)
        relative = np.broadcast_to(np.asarray(view.depth_sigma, dtype=np.float64), (count,))
        found[known, 0] = depth[known]
        found[known, 1] = 1.0 / (depth[known] * relative[known])
    return found


def _rig(views: Sequence[View]) -> Rig:
    posed = [view.cam_from_rig is not None for view in views]
    if any(posed) != all(posed):
        raise InputError(
            "only some views have a known pose",
            where=f"views[{posed.index(False)}].cam_from_rig",
            fix="give it for all views, or for none",
        )
    if not all(posed):
        return Rig(np.tile(_NO_RIG, (len(views), 1)), np.arange(len(views)))
    cameras = [cast(FloatArray, view.cam_from_rig) for view in views]
    rows = [np.concatenate([pose[:3, :3].ravel(), pose[:3, 3]]) for pose in cameras]
    return Rig(np.array(rows), np.zeros(len(views), dtype=np.int64))


def _directions(prior: ShapePrior, views: Sequence[View]) -> Directions:
    numbers = [number for number, view in enumerate(views) if view.up is not None]
    if numbers and prior.up is None:
        fix = "learn it with an up axis, or leave `up` away"
        raise InputError("the model has no up axis", where=f"views[{numbers[0]}].up", fix=fix)
    model = np.tile(np.zeros(3) if prior.up is None else prior.up, (len(numbers), 1))
    camera = [cast(FloatArray, views[number].up) for number in numbers]
    weight = [1.0 / np.radians(views[number].up_sigma_deg) for number in numbers]
    return Directions(
        model,
        np.array(camera).reshape(-1, 3),
        np.array(numbers, dtype=np.int64),
        np.array(weight, dtype=np.float64),
    )
