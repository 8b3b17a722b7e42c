"""Depth images over the visible surface of the object: pixels inside its mask.

A pixel's ray meets the surface at a depth that depends on the pose: the surface's tangent plane at
the point that the ray meets moves along the ray, the point's sliding in the plane does not count to
first order. Each round casts the rays at the present estimate and refines everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import Sight
from cadalign.estimation.contours.measured import Measured, Place, Sought, cost_of
from cadalign.estimation.contours.surface import PosedSurface, caster_of, surfaces_of
from cadalign.estimation.contours.view_contour import robust_deviation
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.search import Minimum
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.evidence import Planes, kept_rows, log_focals_of
from cadalign.solvers.joint.search import score_state

_MARGIN = 3  # [px], to the mask's border
_CELL = 4  # [px], of a silhouette
_LEAST_SPACING = 8  # [px], of samples that count as independent
_MOST_SAMPLES = 100  # of a view
_LOSS_SCALE = 3.0
_GRAZING = 0.2  # cosine between ray and normal below which the depth is not to be trusted
_INDEPENDENT_PARTS = 10.0  # of a surface that is only similar
_ROUNDS = 6
_ITERATIONS = 12
_SETTLED = 0.01  # change of the cost
_MOST_STARTS = 4
_UNLIKELY = 60.0  # excess score of a minimum that is still tried


class _Samples(NamedTuple):
    """Depths (n,) of a view, their rays (n, 3), and their relative standard deviation."""

    image: int
    rays: FloatArray
    depths: FloatArray
    sigma: float


def fit_depths(
    model: Model | ShapeModel,
    prior: ShapePrior,
    views: Sequence[View],
    minima: Sequence[Minimum],
) -> list[Minimum]:
    """Refine the likely minima with the depths of the object's surface, the likeliest first.

    These are the depths inside its mask or, where a photo has neither mask nor keypoints, inside
    the silhouette of the likeliest minimum.
    """
    shown = [number for number, view in enumerate(views) if shows_surface(view)]
    if not shown:
        return list(minima)
    keypoints, first = len(prior.ids), minima[0]
    where = f"views[{shown[0]}].depth"
    surface = surfaces_of(model, first.points[:keypoints], where).surfaces[0]
    posed, poses = None, poses_of(first.evidence, first.state)
    samples = []
    for number in shown:
        view, camera = views[number], first.lenses.cameras[number]
        if view.mask is None:
            posed = posed or surface.at(first.evidence.shape, first.state)
            inside = _silhouette(Sight(posed.caster, camera, poses[number]))
        else:
            inside = np.asarray(view.mask) > 0.5
        samples.append(_samples(number, view, camera, inside))
    samples = [each for each in samples if len(each.depths)]
    if not samples:
        return list(minima)
    is_open = not np.isfinite(first.score)  # without depths nothing is determined
    bound = first.score + _UNLIKELY
    likely = [first, *(each for each in minima[1:] if is_open or each.score < bound)]
    found = []
    for each in likely[:_MOST_STARTS]:
        planes = each.evidence.planes  # depths at keypoints, which may be hidden
        kept = ~np.isin(planes.image, [own.image for own in samples])
        bare = each.evidence._replace(planes=kept_rows(planes, kept))
        sought = Sought(bare, keypoints, samples, surface)
        found.append(_as_begun(each, sought) if is_open else _settled(each, sought))
    found.sort(key=lambda minimum: minimum.score)
    return found


def shows_surface(view: View) -> bool:
    """True if the depths of a view's surface count: those about keypoints count at these."""
    if view.depth_image is None:
        return False
    return view.mask is not None or (view.image is not None and not len(view.keypoint_ids))


def factor_by_depths(mesh: Mesh, view: View, pose: Alignment) -> float | None:
    """Measured over predicted depths, their median, of a mesh in a view with a mask.

    None where none of them is measured.
    """
    samples = _samples(0, view, view.camera, np.asarray(view.mask_image) > 0.5)
    origin, model_from_ray = model_rays(pose)
    face, depth = caster_of(mesh).first_hits(origin, samples.rays @ model_from_ray.T)
    hit = face >= 0
    return float(np.median(samples.depths[hit] / depth[hit])) if hit.any() else None


def _silhouette(sight: Sight) -> BoolArray:
    """Pixels (h, w) where the object is seen, looked at in every so many."""
    rows, columns = (
        np.arange(_CELL // 2, side, _CELL) for side in (sight.camera.height, sight.camera.width)
    )
    covered = sight.covers(np.stack(np.meshgrid(columns, rows), axis=-1))
    return np.kron(covered, np.ones((_CELL, _CELL), dtype=bool)).astype(bool)


def _samples(number: int, view: View, camera: Camera, mask: BoolArray) -> _Samples:
    """Pixels of a grid inside a mask whose depth is known."""
    import cv2  # takes longer to import than all the rest

    depth = cast(FloatArray, view.depth_image)
    inside = np.zeros(depth.shape, dtype=bool)
    height, width = (min(sides) for sides in zip(mask.shape, depth.shape, strict=True))
    inside[:height, :width] = mask[:height, :width]
    padded = np.pad(inside.astype(np.uint8), 1)  # nothing is known of what leaves the image
    size = 2 * _MARGIN + 1
    inside = cv2.erode(padded, np.ones((size, size), np.uint8))[1:-1, 1:-1] > 0
    usable = inside & np.isfinite(depth)
    spacing = max(_LEAST_SPACING, int(np.ceil(np.sqrt(usable.sum() / _MOST_SAMPLES))))
    grid = np.zeros_like(usable)
    grid[spacing // 2 :: spacing, spacing // 2 :: spacing] = True
    rows, columns = np.nonzero(usable & grid)
    rays, valid = camera.normalize_where_valid(np.stack([columns, rows], 1).astype(float))
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    sigma = float(cast(float, view.depth_sigma))
    return _Samples(number, rays[valid], depth[rows, columns][valid], sigma)


def _measured(depths: Sought[_Samples], place: Place) -> list[Measured]:
    """Measurements of the samples of every view at a place."""
    posed, poses = depths.at(place.state)
    ratios = np.exp(log_focals_of(depths.evidence, place.state))
    is_exact = depths.surface.is_exact
    return [
        _rows(posed, poses[each.image], each, ratio=float(ratios[each.image]), is_exact=is_exact)
        for each in depths.views
    ]


def _as_begun(start: Minimum, depths: Sought[_Samples]) -> Minimum:
    """A minimum with the depths at its place, where they alone would lead it astray."""
    place = Place.of(start.state)
    evidence, state, *_ = depths.joined(place, _measured(depths, place))
    cost, score = cost_of(evidence, state), score_state(evidence, state) + start.prior_score
    return start._replace(evidence=evidence, state=state, cost=cost, score=score)


def _settled(start: Minimum, depths: Sought[_Samples]) -> Minimum:
    """Rounds from one minimum until the cost changes little."""
    place, last, result, prior_score = Place.of(start.state), np.inf, start, start.prior_score
    for _ in range(_ROUNDS):
        refined = depths.joined(place, _measured(depths, place)).refined(_ITERATIONS)
        if refined is None:
            return start
        cost, (evidence, state, place, *_) = refined
        score = score_state(evidence, state) + prior_score
        result = start._replace(evidence=evidence, state=state, cost=cost, score=score)
        if abs(last - cost) < _SETTLED:
            break
        last = cost
    return result


def _rows(
    surface: PosedSurface, pose: Alignment, samples: _Samples, *, ratio: float, is_exact: bool
) -> Measured:
    """Points where the rays of samples meet the surface, and planes at their measured depths."""
    origin, model_from_ray = model_rays(pose)
    rays = samples.rays / [ratio, ratio, 1.0]
    directions = rays @ model_from_ray.T
    face, depth = surface.caster.first_hits(origin, directions)
    hit = np.flatnonzero(face >= 0)
    normals = (surface.caster.normals(face[hit]) / pose.scale) @ pose.rotation.T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    along = (normals * rays[hit]).sum(axis=1)
    steep = np.abs(along) > _GRAZING * np.linalg.norm(rays[hit], axis=1)
    hit, normals = hit[steep], normals[steep]
    points = origin + depth[hit, None] * directions[hit]
    measured, sigma, count = samples.depths[hit], samples.sigma, len(hit)
    if not is_exact and count:
        # A surface that is only similar errs alike over large parts, of which few are independent.
        relative = depth[hit] / measured - 1
        own = robust_deviation(relative - np.median(relative))
        sigma = float(np.hypot(sigma, own * np.sqrt(max(count / _INDEPENDENT_PARTS, 1.0))))
    return Measured(
        *surface.rows(points, face[hit]),
        Planes(
            hit,
            np.full(count, samples.image),
            normals,
            samples.rays[hit, :2],
            measured,
            1.0 / (sigma * measured),
            np.full(count, CAUCHY),
            np.full(count, _LOSS_SCALE),
        ),
    )
