"""Depth images over the visible surface of the object: pixels inside its mask, or keypoints.

A pixel's ray meets the surface at a depth that depends on the pose: the surface's tangent plane at
the point that the ray meets moves along the ray, the point's sliding in the plane does not count to
first order. Each round casts the rays at the present estimate and refines everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import Sight
from cadalign.estimation.contours.measured import Measured, Place, Sought, cost_of
from cadalign.estimation.contours.photo_lines import covered_cells
from cadalign.estimation.contours.surface import PosedSurface, Surface, caster_of, surfaces_of
from cadalign.estimation.contours.view_contour import robust_deviation
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.joint_robust import LEAST_SEEN, cost_of_hidden, hidden_limits
from cadalign.estimation.model import Model
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.search import JointProblem, Minimum
from cadalign.estimation.uncertainty.evidence import seen_in_cameras
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment, model_rays
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.evidence import (
    Evidence,
    Planes,
    State,
    kept_rows,
    log_focals_of,
    points_of,
)
from cadalign.solvers.joint.search import refine_joint, score_state

_MARGIN = 3  # [px], to the mask's border
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
_MOST_COVERED = 12
_COVERED = 0.5  # [sigma], of a keypoint behind the surface


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
    shown = [number for number, view in enumerate(views) if view.shows_surface]
    keypoints, first = len(prior.ids), minima[0]
    where = f"views[{shown[0]}].depth"
    surface = surfaces_of(model, first.points[:keypoints], where).surfaces[0]
    samples = []
    for number in shown:
        view, camera = views[number], first.lenses.cameras[number]
        if view.mask is None:
            mask = _silhouette(surface, first, number)
        else:
            mask = np.asarray(view.mask) > 0.5
        samples.append(_samples(number, view, camera, mask))
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


def without_covered(
    model: Model, problem: JointProblem, minima: Sequence[Minimum]
) -> list[Minimum]:
    """Minima by the depths of keypoints that the model's own surface does not hide, the best first.

    A depth image shows that surface in their place. Where next to none is in view, as of keypoints
    inside of the mesh, minima stay as they are.
    """
    first = minima[0]
    keypoints = len(problem.prior.ids)
    surface = surfaces_of(model, first.points[:keypoints], "views[0].depth").surfaces[0]
    likely = [each for each in minima if not each.score > first.score + _UNLIKELY]
    found: dict[tuple[bytes, float], Minimum] = {}
    for each in likely[:_MOST_COVERED]:
        whole = problem.evidence(each.evidence.shape, each.lenses).planes
        uncovered = _uncovered(each, whole, surface, problem.views)
        planes = uncovered.evidence.planes
        found.setdefault((planes.point.tobytes(), round(uncovered.score, 3)), uncovered)
    return sorted(found.values(), key=lambda minimum: minimum.score)


def _uncovered(minimum: Minimum, whole: Planes, surface: Surface, views: Sequence[View]) -> Minimum:
    """The minimum by those of the ``whole`` planes that the surface does not hide.

    Where another object hides a keypoint, the depths' robust loss allows for it.
    """
    evidence, state, own = minimum.evidence._replace(planes=whole), minimum.state, minimum.evidence
    had = set(zip(own.planes.image.tolist(), own.planes.point.tolist(), strict=True))
    rows = zip(whole.image.tolist(), whole.point.tolist(), strict=True)
    shown = np.array([row in had for row in rows])
    # What the score has beside its evidence and the depths that were left out, of keypoints.
    beside = minimum.prior_score - cost_of_hidden(hidden_limits(evidence, state)[0], shown)
    shown = np.zeros(len(whole.point), dtype=bool)
    for _ in range(_ROUNDS):
        again = ~_is_covered(evidence, state, surface, views)
        if again.sum() < LEAST_SEEN or (again == shown).all():
            break
        shown = again
        some = evidence._replace(planes=kept_rows(whole, shown))
        cost, moved, _, _ = refine_joint(some, _ITERATIONS, state)
        score = beside + score_state(some, moved)
        if not np.isfinite(score):
            break
        state = moved
        minimum = minimum._replace(evidence=some, state=state, cost=cost, score=score)
    return minimum


def _is_covered(
    evidence: Evidence, state: State, surface: Surface, views: Sequence[View]
) -> BoolArray:
    """Marks the planes (m,) of keypoints that lie behind the surface."""
    planes, posed = evidence.planes, surface.at(evidence.shape, state)
    points = points_of(evidence.shape, state)[planes.point]
    seen = seen_in_cameras(evidence, state, points, planes.image)
    covered = np.zeros(len(points), dtype=bool)
    for number, pose in enumerate(poses_of(evidence, state)):
        rows = np.flatnonzero(planes.image == number)
        if views[number].shows_surface or not len(rows):
            continue
        origin, model_from_ray = model_rays(pose)
        rays = seen[rows] / seen[rows, 2:]
        face, depth = posed.caster.first_hits(origin, rays @ model_from_ray.T)
        nearer = (seen[rows, 2] - depth) * planes.weight[rows]
        covered[rows] = (face >= 0) & (nearer > _COVERED)
    return covered


def factors_by_depths(mesh: Mesh, view: View, poses: Sequence[Alignment]) -> list[float]:
    """Measured over predicted depths of a mesh in a view with a mask, their median at each pose.

    NaN where none of them is measured.
    """
    samples, caster = _samples(0, view, view.camera, np.asarray(view.mask) > 0.5), caster_of(mesh)
    factors = []
    for pose in poses:
        origin, model_from_ray = model_rays(pose)
        face, depth = caster.first_hits(origin, samples.rays @ model_from_ray.T)
        hit = face >= 0
        ratios = samples.depths[hit] / depth[hit]
        factors.append(float(np.median(ratios)) if len(ratios) else np.nan)
    return factors


def _silhouette(surface: Surface, minimum: Minimum, number: int) -> BoolArray:
    """Pixels (h, w) where a view shows the surface at a minimum."""
    evidence, state, camera = minimum.evidence, minimum.state, minimum.lenses.cameras[number]
    posed, pose = surface.at(evidence.shape, state), poses_of(evidence, state)[number]
    size = camera.height, camera.width
    return covered_cells(Sight(posed.caster, camera, pose), np.zeros(2), 1.0, size)


def _samples(number: int, view: View, camera: Camera, mask: BoolArray) -> _Samples:
    """Pixels of a grid inside a mask whose depth is known."""
    padded = np.pad(mask.astype(np.uint8), 1)  # nothing is known of what leaves the image
    size = 2 * _MARGIN + 1
    inside = cv2.erode(padded, np.ones((size, size), np.uint8))[1:-1, 1:-1] > 0
    depth = cast(FloatArray, view.depth_image)
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
