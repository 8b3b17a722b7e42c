"""Views that an alignment is prepared for, and what brings its result back to the views given.

Views of wide lenses are turned to their keypoints; views of unknown motion whose keypoints
determine no pose are left out, or begin at the pose by their mask alone; a rig of which one view
alone determines the pose begins there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.estimates import mean_state
from cadalign.estimation.model import is_exact_model
from cadalign.estimation.options import pixel_information
from cadalign.estimation.pack import evidence_of, tells_something
from cadalign.estimation.prior import ShapePrior, with_known_shape
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Stated, Statistics, ViewResult
from cadalign.estimation.view import View
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.alignment import Alignment, are_on_a_line
from cadalign.geometry.camera import (
    Camera,
    faced,
    needs_facing,
    rays_ahead,
    turned_alignment,
    turned_covariance,
)
from cadalign.io.evidence import Size
from cadalign.solvers.constants import LEAST_POINTS
from cadalign.solvers.joint.search import refine_joint

Align = Callable[[Sequence[View], Sequence[Alignment | None]], Result]
"""Alignment of some views, with a start or None for each."""

_ON_A_LINE = 1e-3  # second over first extent of keypoints that determine no rotation about it
_ITERATIONS = 50
_MOST_STARTS = 8
_LEAST_AHEAD = 0.05  # cosine off a wide lens's axis below which a depth says nothing of a point
_MOST_PIXELS = 500  # of a mask, amid which a wide lens is turned


def views_without_pose(
    prior: ShapePrior, views: Sequence[View], inits: Sequence[Alignment | None]
) -> list[int]:
    """Numbers of the views of unknown motion whose keypoints determine no pose.

    Those are fewer than three keypoints, or keypoints on one line. A single view, views of a rig,
    views with a given start, and views without evidence are never among them.
    """
    if len(views) < 2 or any(view.cam_from_rig is not None for view in views):
        return []
    mean = prior.components[0].mean
    return [
        number
        for number, view in enumerate(views)
        if inits[number] is None
        and tells_something(view)
        and _lie_on_a_line(mean[prior.rows_of(view.keypoint_ids, f"views[{view.number}].ids")])
    ]


def with_poses_by_masks(
    model: object, views: Sequence[View], inits: Sequence[Alignment | None], align_some: Align
) -> list[Alignment | None]:
    """Starts, with those that masks alone suggest for views of unknown motion without keypoints.

    The model is exact and has a mesh: others would meet no mask.
    """
    found = list(inits)
    if len(views) < 2 or not is_exact_model(model) or getattr(model, "mesh", None) is None:
        return found
    for number, view in enumerate(views):
        if found[number] is None and view.has_mask_alone and view.cam_from_rig is None:
            with contextlib.suppress(DegenerateError):  # it is left out
                found[number] = align_some([view], [None]).alignment
    return found


def align_without(
    left_out: Sequence[int],
    prior: ShapePrior,
    views: Sequence[View],
    inits: Sequence[Alignment | None],
    align_some: Align,
) -> Result:
    """Align the views that are not ``left_out``; the result is that of all of them.

    The pose of a view that is left out is one of those that explain its keypoints. Raises
    DegenerateError if it is the first one, whose camera's frame is that of the result.
    """
    if 0 in left_out:
        raise DegenerateError(
            "its keypoints do not determine its pose, and the result is in its camera's frame",
            where="views[0]",
            fix="give at least 3 keypoints, not on one line, or another view first",
        )
    used = [number for number in range(len(views)) if number not in left_out]
    result = align_some([views[n] for n in used], [inits[n] for n in used])
    of_views = dict(zip(used, result.views, strict=True))
    masks = dict(zip(used, result.mask_residuals, strict=bool(result.mask_residuals)))
    estimated = dict(zip((views[n].camera for n in used), result.cameras, strict=True))
    for number in left_out:
        view = views[number]
        camera = _camera_of(view, estimated)
        pose = _explaining(prior, view, camera, result)
        rows = prior.rows_of(view.keypoint_ids, f"views[{view.number}].ids")
        observed = view.pixels
        residuals = camera.project(pose.apply(result.points_3d[rows])) - observed
        kept, unknown = np.zeros(len(rows), dtype=bool), Stated(None)
        of_views[number] = ViewResult(
            camera, pose, view.keypoint_ids, observed, residuals, kept, unknown
        )
    numbers = range(len(views))
    warnings = (*result.warnings, *(_left_out_warning(views[number]) for number in left_out))
    statistics = Stated.of(result.statistics, warnings=warnings)
    return replace(
        result,
        views=tuple(of_views[number] for number in numbers),
        statistics=statistics,
        mask_residuals=tuple(masks.get(number) for number in numbers) if masks else (),
    )


def _left_out_warning(view: View) -> EstimateWarning:
    count = len(view.keypoint_ids)
    text = f"views[{view.number}] is left out: its {count} keypoints do not determine its pose"
    return EstimateWarning("left-out", text, view.number)


def _lie_on_a_line(points: FloatArray) -> bool:
    """True for points (n, 3) that determine no rotation: fewer than three, or on one line."""
    return len(points) < LEAST_POINTS or are_on_a_line(points, _ON_A_LINE)


def _camera_of(view: View, estimated: Mapping[Camera, Camera]) -> Camera:
    """The camera of a view; an unknown focal length is that of an equal camera, or of the first."""
    if view.camera in estimated or view.camera.focal_known:
        return estimated.get(view.camera, view.camera)
    first = next(iter(estimated.values()))
    side = max(view.camera.width, view.camera.height) / max(first.width, first.height)
    return view.camera.with_focal(first.fx * side)


def _explaining(prior: ShapePrior, view: View, camera: Camera, result: Result) -> Alignment:
    """A pose near that of the first view under which a view's keypoints fit."""
    scale = result.alignment.scale
    alone = View(
        camera,
        view.points_2d,
        ids=view.ids,
        sigma=view.sigma,
        scores=view.scores,
        up=view.up,
        up_sigma_deg=view.up_sigma_deg,
    )
    if not len(view.keypoint_ids) and view.up is None:
        return result.alignment
    points = np.concatenate([result.points_3d, result.bounds])
    evidence = with_known_shape(evidence_of(prior, [alone]), points)
    state = mean_state(evidence, result.alignment.packed[None, :12], np.log(scale))
    _, state, _, _ = refine_joint(evidence, _ITERATIONS, state)
    return Alignment(state.poses[0, :9].reshape(3, 3), state.poses[0, 9:], scale)


def starts_by_one_view(
    views: Sequence[View], size: Size | None, align_some: Align
) -> list[list[Alignment | None]]:
    """Starts, the likeliest first, of a rig whose outlines alone tell the object's size.

    One view determines the pose: the only one with keypoints or, without any, that of the largest
    mask. The object is enlarged about its camera until it is seen amid the masks of the others.
    There are none for other views. Raises CadalignError if that view alone has no estimate.
    """
    if any(view.cam_from_rig is None for view in views):
        return []
    seen = [number for number, view in enumerate(views) if len(view.keypoint_ids)]
    has_size = size is not None or any(view.depth is not None for view in views)
    has_size |= any(view.camera_height is not None for view in views)
    given = {n: np.asarray(view.mask) for n, view in enumerate(views) if view.mask is not None}
    masks = {number: mask > 0.5 for number, mask in given.items() if mask.max() > 0.5}
    if len(seen) > 1 or (seen and has_size) or not masks:
        return []
    first = seen[0] if seen else max(masks, key=lambda number: int(masks[number].sum()))
    others = [number for number in masks if number != first]
    if not others:
        return []
    alone = align_some([replace(views[first], cam_from_rig=None)], [None])
    camera, known = np.asarray(views[first].cam_from_rig), {views[first].camera: alone.camera}
    middles = []
    for number in others:
        own = np.asarray(views[number].cam_from_rig) @ np.linalg.inv(camera)
        middle = np.argwhere(masks[number]).mean(axis=0)[None, ::-1]
        middles.append((own, _camera_of(views[number], known).normalize(middle)[0]))
    starts: list[list[Alignment | None]] = []
    turn = camera[:3, :3].T
    likely = [(alone.alignment, alone.box)]
    likely += [(each.alignment, each.box) for each in alone.alternatives]
    for pose, box in likely[:_MOST_STARTS]:
        factor = _factor_amid(box.center, middles)
        if factor > 0:
            shift = turn @ (factor * pose.translation - camera[:3, 3])
            enlarged = Alignment(turn @ pose.rotation, shift, factor * pose.scale)
            starts.append([enlarged, *[None] * (len(views) - 1)])
    return starts


def _factor_amid(center: FloatArray, middles: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Factor of a point's distance from its camera that puts it amid masks; NaN or less for none.

    These are of cameras of known pose (4, 4) in the point's, which see their middles by rays (2,).
    """
    by_factor, rest = [], []
    for own, ray in middles:
        along, offset = own[:3, :3] @ center, own[:3, 3]
        by_factor.append(along[:2] - ray * along[2])
        rest.append(offset[:2] - ray * offset[2])
    first, second = np.concatenate(by_factor), np.concatenate(rest)
    squares = first @ first
    return -float(first @ second / squares) if squares > 0 else 0.0


def facing_view(view: View) -> View:
    """The view in the frame that faces what it shows; ``up`` and the like stay in the lens's.

    Depths, along the lens's axis as they are given, become those along the frame's.
    """
    if not needs_facing([view.camera]):
        return view
    camera = faced(view.camera, _shown_by(view))
    rig = view.cam_from_rig
    if rig is not None:
        turn = np.eye(4)
        turn[:3, :3] = camera.lens_from_camera.T
        rig = turn @ np.asarray(rig)
    turned = replace(view, camera=camera, cam_from_rig=rig)
    return turned if view.depth is None else _with_facing_depths(turned, view.camera)


def _shown_by(view: View) -> FloatArray:
    """Pixels (n, 2) where a view shows the object: its keypoints or, without any, its mask."""
    if not view.has_mask_alone:
        return view.pixels
    inside = np.argwhere(np.asarray(view.mask) > 0.5)[:, ::-1]
    return inside[:: max(len(inside) // _MOST_PIXELS, 1)].astype(float)


def _with_facing_depths(turned: View, lens: Camera) -> View:
    """A turned view whose depths, along the axis of its lens, become those along its own.

    NaN for those of points beside the lens, of which that axis says nothing. A keypoint's noise
    turns its ray, which adds to the standard deviation of its depth.
    """
    depth = np.array(turned.depth, dtype=np.float64)
    known = np.isfinite(depth)
    is_image = depth.ndim == 2
    pixels = np.argwhere(known)[:, ::-1].astype(float) if is_image else turned.pixels[known]
    rays, valid = lens.rays_where_valid(pixels)
    along, ahead = rays[:, 2], rays @ turned.camera.lens_from_camera[:, 2]
    usable = valid & (along > _LEAST_AHEAD) & (ahead > _LEAST_AHEAD)
    along, ahead = (np.where(usable, each, 1.0) for each in (along, ahead))
    depth[known] *= np.where(usable, ahead / along, np.nan)
    if is_image:
        return replace(turned, depth=depth)
    noise = 1.0 if turned.sigma is None else turned.sigma
    variances = np.linalg.inv(pixel_information(noise, len(depth)))[known]
    angles = np.sqrt(np.trace(variances, axis1=1, axis2=2) / 2) / lens.fx
    sigma = np.broadcast_to(np.asarray(turned.depth_sigma, dtype=np.float64), depth.shape).copy()
    sigma[known] = np.sqrt(sigma[known] ** 2 + angles**2 * (along**-2 - 1 + ahead**-2 - 1))
    return replace(turned, depth=depth, depth_sigma=sigma)


def align_facing(
    given: Sequence[View],
    inits: Sequence[Alignment | None],
    align_some: Align,
    *,
    may_surround: bool,
) -> Result:
    """Align views in the frames of `facing_view`; the result is in those that were given.

    Raises InputError if keypoints lie all around a wide lens, unless they ``may_surround`` it.
    """
    views = [facing_view(view) for view in given]
    for view in views:
        if view.camera.is_wide and not may_surround:
            rays_ahead(view.pixels, view.camera)
    if views[0].cam_from_rig is None:  # a start in the rig's frame stays
        inits = [
            None if init is None else turned_alignment(init, view.camera.lens_from_camera.T)
            for init, view in zip(inits, views, strict=True)
        ]
    result = align_some(views, inits)
    statistics = _turned(result.statistics, result.camera.lens_from_camera)
    turned = []
    for number, (own, view) in enumerate(zip(result.views, given, strict=True)):
        turn = own.camera.lens_from_camera if view.camera.is_wide else np.eye(3)
        turned.append(
            replace(
                own,
                camera=view.camera if view.camera.is_wide else own.camera,
                alignment=turned_alignment(own.alignment, turn),
                statistics=_turned(own.statistics, turn) if number else statistics,
            )
        )
    turn = result.camera.lens_from_camera
    others = [
        replace(each, alignment=turned_alignment(each.alignment, turn), camera=given[0].camera)
        for each in result.alternatives
    ]
    return replace(
        result,
        views=tuple(turned),
        statistics=statistics,
        alternatives=tuple(others),
    )


def _turned(statistics: Statistics, turn: FloatArray) -> Stated:
    own, fisher = statistics.covariance, statistics.fisher_covariance
    seen = statistics.points_cam_covariance
    return Stated.of(
        statistics,
        covariance=None if own is None else turned_covariance(own, turn),
        fisher_covariance=None if fisher is None else turned_covariance(fisher, turn),
        points_cam_covariance=None if seen is None else turn @ seen @ turn.T,
    )
