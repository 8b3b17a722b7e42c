"""Convert views to evidence in the form of the kernels.

Depth images are sampled at keypoints; gravity, camera heights and lengths become known directions
and distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.prior import Lenses, ShapePrior, scale_priors
from cadalign.estimation.problems import rays_of, whitening_of
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera
from cadalign.io.evidence import LENGTHS, Size
from cadalign.solvers.joint.evidence import (
    Directions,
    Evidence,
    Offsets,
    Rig,
    Shape,
    Sightings,
    kept_rows,
    stack_tables,
)
from cadalign.solvers.marginal.problem import Seen

_DEPTH_LOSS_SCALE = 3.0  # [sigma], of depths in an image, for occluded keypoints
_RADIUS = 2  # of the window around a keypoint [px]
_GAP = 4.0  # between surfaces in a window [sigma]
_LEAST_PIXELS = 3  # of a surface in a window


def evidence_of(
    prior: ShapePrior,
    shape: Shape,
    views: Sequence[View],
    size: Size | None,
    *,
    options: FitOptions,
    lenses: Lenses,
    turns: Sequence[FloatArray],
    noise: float,
) -> Evidence:
    """Evidence of the views, the size and one component of the prior.

    ``turns`` (3, 3) turn wide lenses; ``noise`` [px] is the sigma of keypoints without one. Raises
    InputError if the model lacks a keypoint or an up axis, or if only some views have a pose.
    """
    rows = [prior.rows_of(view.keypoint_ids, f"views[{view.number}].ids") for view in views]
    offsets = known_distances(prior, views, size)
    directions = known_directions(prior, views)
    sightings = _sightings(rows, views, lenses.cameras, noise, options)
    # Directions from the lenses' frames to the frames of turned cameras.
    of_lenses = np.array([camera.lens_from_camera for camera in lenses.cameras])
    turned = of_lenses[directions.image]
    directions = directions._replace(
        camera=np.einsum("dij,di->dj", turned, directions.camera),
        whitening=directions.whitening @ turned,
    )
    is_rig = len(views) > 1 and views[0].cam_from_rig is not None
    is_metric = bool(is_rig or len(offsets.value) or sightings.depths[:, 1].any())
    return Evidence(
        shape,
        sightings,
        _rig(views, turns, of_lenses[:, 2]),
        lenses.focals(),
        scale_priors(prior, is_metric),
        (directions, offsets),
    )


def _sightings(
    names: Sequence[list[int]],
    views: Sequence[View],
    cameras: Sequence[Camera],
    noise: float,
    options: FitOptions,
) -> Sightings:
    tables = []
    for number, (rows, view, camera) in enumerate(zip(names, views, cameras, strict=True)):
        pixels, count = view.pixels, len(rows)
        rays = rays_of(np.require(pixels, requirements="W"), camera, clips=True)
        sigma = noise if view.sigma is None else view.sigma
        tables.append(
            Sightings(
                np.array(rows, dtype=np.int64),
                np.full(count, number),
                rays,
                np.broadcast_to(whitening_of(sigma, rays, camera), (count, 3)),
                _keypoint_depths(view, count),
                np.full(count, LOSSES[options.loss]),
                np.full(count, float(options.loss_scale)),
            )
        )
    whole = stack_tables(tables)
    return kept_rows(whole, np.argsort(whole.point, kind="stable"))


def _keypoint_depths(view: View, count: int) -> FloatArray:
    """Depths (n, 3) for `Sightings`; keypoints in a depth image may be occluded."""
    found = np.zeros((count, 3))
    if view.depth is None:
        return found
    if view.depth_image is None:
        depth = cast(FloatArray, view.depth)
        deviations, scale = depth * np.asarray(view.depth_sigma, dtype=np.float64), 0.0
    else:
        relative, scale = float(cast(float, view.depth_sigma)), _DEPTH_LOSS_SCALE
        depth, deviations = sample_depth(view.depth_image, view.pixels, sigma=relative)
    known = np.isfinite(depth)
    found[known] = np.column_stack([depth, 1.0 / deviations, np.full(count, scale)])[known]
    return found


def sample_depth(
    image: FloatArray, points_2d: FloatArray, *, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Depths (n,) of keypoints in a depth image, and their deviations (n,); NaN if unknown.

    At a silhouette, the window around a keypoint also shows the background. It is split at gaps of
    several ``sigma`` (relative), and the nearest surface is used; a steep one has a larger
    deviation.
    """
    height, width = image.shape
    found, deviations = np.full((2, len(points_2d)), np.nan)
    for row, (x, y) in enumerate(points_2d):
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            continue
        left, top = round(float(x)) - _RADIUS, round(float(y)) - _RADIUS
        window = image[max(top, 0) : top + 2 * _RADIUS + 1, max(left, 0) : left + 2 * _RADIUS + 1]
        depths = np.sort(window[np.isfinite(window)])
        breaks = np.flatnonzero(np.diff(depths) > _GAP * sigma * depths[:-1]) + 1
        surfaces = [part for part in np.split(depths, breaks) if len(part) >= _LEAST_PIXELS]
        if surfaces:
            found[row] = np.median(surfaces[0])
            deviations[row] = max(sigma * found[row], surfaces[0].std())
    return found, deviations


def _rig(views: Sequence[View], turns: Sequence[FloatArray], axes: FloatArray) -> Rig:
    """Motions and axes of cameras, and the index of each camera's pose, -1 without evidence."""
    posed = [view.cam_from_rig is not None for view in views]
    if any(posed) != all(posed):
        raise InputError(
            "only some views have a known pose",
            where=f"views[{views[posed.index(False)].number}].cam_from_rig",
            fix="give it for all views, or for none",
        )
    is_rig = all(posed)
    rows = []
    for turn, view in zip(turns, views, strict=True):
        motion = turn.T @ np.asarray(view.cam_from_rig if is_rig else np.eye(4))[:3]
        rows.append(np.append(motion[:, :3], motion[:, 3]))
    if is_rig:
        return Rig(np.array(rows), np.zeros(len(views), dtype=np.int64), axes)
    takes_part = np.array([view.has_evidence for view in views])
    return Rig(np.array(rows), np.where(takes_part, takes_part.cumsum() - 1, -1), axes)


def seen_keypoints(view: View, pixels: FloatArray, rows: list[int], options: FitOptions) -> Seen:
    """Keypoints of a view at pixels (n, 2), in the form of the single-view kernels."""
    rays = rays_of(np.require(pixels, requirements="W"), view.camera)
    whitening = np.empty((len(rows), 3))
    whitening[:] = whitening_of(view.sigma, rays, view.camera)
    loss, scale = LOSSES[options.loss], float(options.loss_scale)
    return Seen(np.array(rows, dtype=np.int64), rays, whitening, loss, scale)


_CAMERA = -1  # in the place of a point's row


def known_directions(prior: ShapePrior, views: Sequence[View]) -> Directions:
    """Gravity in the views; raises InputError if the model has no up axis."""
    numbers = [number for number, view in enumerate(views) if view.up is not None]
    ups = [cast(FloatArray, views[number].up) for number in numbers]
    whitening = [
        _whitening(up, views[number].up_sigma_deg) for number, up in zip(numbers, ups, strict=True)
    ]
    axes = [_upward("up", prior, views[number]) for number in numbers]
    return Directions(
        np.array(axes, dtype=float).reshape(-1, 3),
        np.array(ups, dtype=float).reshape(-1, 3),
        np.array(numbers, dtype=np.int64),
        np.array(whitening).reshape(-1, 3, 3),
    )


def _whitening(direction: FloatArray, sigma_deg: Any) -> FloatArray:
    """Whitening (3, 3) of a unit vector [1/rad], from its deviation or covariance [degrees]."""
    sigma = np.asarray(sigma_deg, dtype=np.float64)
    if not sigma.ndim:
        return np.asarray(np.eye(3) / np.radians(sigma))
    along = np.outer(direction, direction)
    across = np.eye(3) - along
    covariance = across @ np.radians(np.radians(sigma)) @ across
    largest = np.linalg.eigvalsh(covariance)[-1]
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance + largest * along)).T)


def known_distances(prior: ShapePrior, views: Sequence[View], size: Size | None) -> Offsets:
    """Lengths of the box between its corners, and heights of cameras above the lowest corner."""
    shape = prior.components[0]
    corners, rows = len(shape.mean) - 2, []
    if size is not None:
        own = (shape.spread[-2:] ** 2).sum()  # displacements of the corners
        for axis in np.flatnonzero(np.isfinite(size.lengths)).tolist():
            if not prior.lengths[axis] > 0:
                what = f"the model has no extent along its {'xyz'[axis]}"
                raise InputError(what, where=f"size.{LENGTHS[axis]}", fix="omit it")
            sigma = float(np.sqrt(size.deviations[axis] ** 2 + own))
            rows.append(((corners, corners + 1), -1, np.eye(3)[axis], size.lengths[axis], sigma))
    for number, view in enumerate(views):
        if view.camera_height is None:
            continue
        up, height = _upward("camera_height", prior, view), view.camera_height
        lowest = corners + (0 if up.sum() > 0 else 1)  # the corner that lies in the lowest face
        relative = cast(float, view.camera_height_sigma)
        sigma = float(np.hypot(height * relative, shape.spread[lowest]))
        rows.append(((lowest, _CAMERA), number, up, height, sigma))
    ends, images, directions, values, sigmas = zip(*rows, strict=True) if rows else [()] * 5
    return Offsets(
        np.array(ends, dtype=np.int64).reshape(-1, 2),
        np.array(images, dtype=np.int64),
        np.array(directions, dtype=float).reshape(-1, 3),
        np.array(values, dtype=float),
        1.0 / np.array(sigmas, dtype=float),
    )


def _upward(field: str, prior: ShapePrior, view: View) -> FloatArray:
    """The model's up axis (3,), which ``field`` needs; raises InputError without one."""
    if prior.up is None:
        fix = f"learn it with an up axis, or omit `{field}`"
        raise InputError("the model has no up axis", where=f"views[{view.number}].{field}", fix=fix)
    return prior.up
