"""Next-best evidence: what to add to the views of an object, by its predicted effect.

The effect is predicted on a scene in which all evidence agrees with the estimate.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, quote
from cadalign.estimation.estimates import (
    curvature_of_rotations,
    pose_and_border,
    pose_and_lengths,
    with_box,
)
from cadalign.estimation.facing import turned_alignment, turned_covariance
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prepared_views import facing_view
from cadalign.estimation.prior import ShapePrior, is_exact, prior_of, widened
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import needs_facing
from cadalign.geometry.rotations import nearest_rotation, rotation_from_vector
from cadalign.io.evidence import LENGTHS, Size
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import Evidence, Shape, State

TURN_DEG = 25.0  # of another view about the object
_MASK_SIGMA = 1.5  # of a contour as segmentation gives it [px]
LENGTH_SIGMA = 0.01
_LEAST_SPREAD = 1e-6  # of points whose displacements a shape leaves out [model units]


@dataclass(frozen=True)
class Advice:
    """One piece of evidence that could be added, and the standard deviations with it."""

    kind: str
    detail: Hashable
    """Id of the keypoint; names of the two lengths; empty otherwise."""
    rotation_deg: float
    """Standard deviation of the rotation [degrees]."""
    position: float
    """Standard deviation of the translation, over the distance."""
    stretch: tuple[float, float, float]
    """Relative standard deviations of the lengths along x, y, z."""
    view: int = 0
    """Number of the view that a keypoint or a mask is added to."""

    @property
    def worst(self) -> float:
        """The largest deviation: rotation in radians, position, stretch."""
        return max(float(np.radians(self.rotation_deg)), self.position, *self.stretch)


def rank_evidence(
    model: Model | ShapeModel,
    views: View | Sequence[View],
    estimate: Alignment | Result,
    *,
    candidates: Sequence[Hashable] = (),
    mask: npt.ArrayLike | None = None,
    size: Size | None = None,
) -> tuple[Advice, ...]:
    """Rank what could be added to the evidence of an object's views, the most useful first.

    Compared is the largest standard deviation that is left, linearised at the estimate; what is
    known of a learned or similar shape counts. A further view is one of the first view's keypoints
    from 25 deg aside, its motion known where that of the others is. Lengths are the object's width
    and the less certain of its height and length, measured to 1 %, or the one of them that is still
    unknown.

    Parameters
    ----------
    model : Model or ShapeModel
    views : View or sequence of View
        All that is there; a depth image counts by its depths at keypoints.
    estimate : Alignment or Result
        The estimate from them. An alignment, in the first camera, suffices for an exact model and
        one view, or views with ``cam_from_rig``.
    candidates : sequence of int or str
        Ids of keypoints that could be marked in any view that lacks them and whose image they lie
        in, as precisely as the others on average.
    mask : (h, w) bool, optional
        The mask that is predicted for the estimate in the first view, where one could be drawn; the
        model then needs its mesh. Its contour counts with a standard deviation of 1.5 px.
    size : Size, optional
        The lengths that are known.

    Returns
    -------
    tuple of Advice

    Raises
    ------
    InputError
        If the model lacks a keypoint or the mesh, every view has a candidate, an alignment does not
        suffice, or there is a mask and the model is not exact.

    Examples
    --------
    >>> from cadalign import Camera
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    >>> camera = Camera(640, 480, 900, 900, 319.5, 239.5)
    >>> truth = Alignment(np.diag([-1.0, -1.0, 1.0]), [0.3, 0.2, 6.0], np.ones(3))
    >>> seen = View(camera, camera.project(truth.apply(corners[:6])), ids=range(6))
    >>> first, *others = rank_evidence(Model(points_3d=corners), seen, truth, candidates=[6, 7])
    >>> first.kind, len(others)
    ('lengths', 3)
    """
    given = (views,) if isinstance(views, View) else tuple(views)
    scene = _scene_of(model, given, estimate, size)
    found = [each for name in candidates for each in _keypoints(scene, name)]
    # Beside several views, a further one stands on the more informative side.
    turns = (TURN_DEG,) if len(given) == 1 else (TURN_DEG, -TURN_DEG)
    found.append(min((_advice("view", "", _with_view(scene, t)) for t in turns), key=_worst))
    found.extend(_lengths(scene))
    if mask is not None and given[0].mask is None:
        first = replace(given[0], mask=mask, mask_sigma=_MASK_SIGMA)
        masked = _scene_of(model, (first, *given[1:]), estimate, size)
        found.append(_advice("mask", "", masked))
    return tuple(sorted(found, key=_worst))


_worst = attrgetter("worst")


def _with_view(scene: _KnownScene, turn_deg: float) -> _KnownScene:
    """The scene, and the first view's keypoints in a camera that went around the object."""
    view, pose = scene.views[0], scene.poses[0]
    centre = pose.apply(scene.bounds.mean(axis=0)[None])[0]
    turn = rotation_from_vector(np.array([0.0, np.radians(turn_deg), 0.0]))
    step = Alignment(turn, centre - turn @ centre, np.ones(3))
    moved, motion = step @ pose, None
    if view.cam_from_rig is not None:
        motion = step.cam_from_model @ cast(FloatArray, view.cam_from_rig)
        motion[:3, :3] = nearest_rotation(motion[:3, :3])
    points = view.camera.project(moved.apply(scene.points_of(view.keypoint_ids)))
    ids, sigma = view.keypoint_ids, view.sigma
    added = View(view.camera, points, ids=ids, sigma=sigma, cam_from_rig=motion)
    return replace(scene, views=(*scene.views, added), poses=(*scene.poses, moved))


def _lengths(scene: _KnownScene) -> Iterator[Advice]:
    """The unknown one of the width and another length, or both, that leaves the least open."""
    lengths = np.ptp(scene.bounds, axis=0) * scene.poses[0].scale
    known = np.full(3, np.nan) if scene.size is None else scene.size.lengths
    stated = LENGTH_SIGMA if scene.size is None else scene.size.relative
    sigma = np.where(np.isfinite(known), stated, LENGTH_SIGMA)
    rows = [(0, 1), (0, 2)] if np.isnan(known[0]) else [(1,), (2,)]
    found = []
    for axes in rows:
        new = [axis for axis in axes if np.isnan(known[axis])]
        if not new or not (lengths[new] > 0).all():
            continue
        all_of_them = known.copy()
        all_of_them[new] = lengths[new]
        told = dict(zip(LENGTHS, all_of_them.tolist(), strict=True))
        size = Size(**{name: value for name, value in told.items() if value == value}, sigma=sigma)
        detail = " and ".join(LENGTHS[axis] for axis in new)
        found.append(_advice("lengths", detail, replace(scene, size=size)))
    if found:
        yield min(found, key=_worst)


def _keypoints(scene: _KnownScene, name: Hashable) -> Iterator[Advice]:
    """A keypoint in every view that lacks it and can show it."""
    lacking = [n for n, view in enumerate(scene.views) if name not in view.keypoint_ids]
    if not lacking:
        fix = "give those that a view lacks"
        raise InputError(f"every view has the keypoint {quote(name)}", where="candidates", fix=fix)
    for number in lacking:
        camera, point = scene.views[number].camera, scene.points_of((name,), "candidates")
        place = camera.project(scene.poses[number].apply(point))
        if len(scene.views) == 1 or camera.contains(place).all():
            views = list(scene.views)
            views[number] = _with_keypoint(views[number], name, place)
            marked = _advice("keypoint", name, replace(scene, views=tuple(views)))
            yield replace(marked, view=number)


def _with_keypoint(view: View, name: Hashable, place: FloatArray) -> View:
    depth = view.depth
    if depth is not None and view.depth_image is None:
        depth = np.append(cast(FloatArray, depth), np.nan)
    return replace(
        view,
        points_2d=np.vstack([view.pixels, place]),
        ids=(*view.keypoint_ids, name),
        sigma=1.0 if view.sigma is None else _with_mean(view.sigma),
        scores=None,
        depth=depth,
        depth_sigma=_with_mean(cast(npt.ArrayLike, view.depth_sigma)),
    )


def _with_mean(sigma: npt.ArrayLike) -> npt.ArrayLike:
    """One deviation of all values, or those of each and their mean for one more."""
    given = np.asarray(sigma, dtype=np.float64)
    if given.ndim == 0:
        return given
    return np.concatenate([given, given.mean(axis=0, keepdims=True)]) if len(given) else 1.0


def _advice(kind: str, detail: Hashable, scene: _KnownScene) -> Advice:
    """The effect of evidence that agrees with the estimate, up to scale."""
    covariance, alignment = scene.covariance(), scene.poses[0]
    distance = float(np.linalg.norm(alignment.translation))
    # Translation over the distance, and lengths, relative to the length along x.
    terms = np.zeros((9, 9))
    terms[:3, :3] = np.eye(3)
    terms[3:6, 3:6] = np.eye(3) / distance
    terms[3:6, 6] = -alignment.translation / distance
    terms[6:, 6:] = np.eye(3)
    terms[6:, 6] -= 1.0
    deviations = np.sqrt(np.maximum((terms @ covariance @ terms.T).diagonal(), 0.0))
    x, y, z = deviations[6:].tolist()
    rotation_deg = float(np.degrees(np.linalg.norm(deviations[:3])))
    return Advice(kind, detail, rotation_deg, float(np.linalg.norm(deviations[3:6])), (x, y, z))


@dataclass(frozen=True, eq=False)
class _KnownScene:
    """Views of an object whose pose, stretch and shape are taken as known."""

    model: Model | ShapeModel
    prior: ShapePrior  # its one component is that of the object
    views: tuple[View, ...]
    poses: tuple[Alignment, ...]  # in every view's camera
    points_3d: FloatArray  # (m, 3) before the stretch
    bounds: FloatArray  # (2, 3)
    size: Size | None

    def points_of(self, ids: Sequence[Hashable], where: str = "ids") -> FloatArray:
        return np.asarray(self.points_3d[self.prior.rows_of(tuple(ids), where)])

    def covariance(self) -> FloatArray:
        """Covariance (9, 9) of an estimate, as `cadalign.Result.covariance`, linearised."""
        if needs_facing([view.camera for view in self.views]):
            views = tuple(map(facing_view, self.views))
            turns = [view.camera.lens_from_camera for view in views]
            pairs = zip(self.poses, turns, strict=True)
            poses = tuple(turned_alignment(pose, turn.T) for pose, turn in pairs)
            facing = replace(self, views=views, poses=poses)
            return turned_covariance(facing.covariance(), turns[0])
        evidence = evidence_of(self.prior, self.views, self.size)
        evidence, state = widened(evidence, self._state(evidence), self.prior.inflation)
        known = is_exact(evidence)
        evidence, state = with_box(evidence, state, self.prior)
        if isinstance(self.model, Model) and any(view.mask is not None for view in self.views):
            # With OpenCV and embree.
            from cadalign.estimation.contours.view_contour import with_contours

            evidence, state = with_contours(self.model, self.views, evidence, state)
        found = joint_covariance(evidence, state)
        unknowns = pose_and_border(found, int(evidence.rig.pose[0]))
        covariance = pose_and_lengths(evidence, state, unknowns)
        symmetry = self.model.symmetry if isinstance(self.model, Model) else None
        if symmetry is None and not known:
            covariance[:3, :3] += curvature_of_rotations(covariance[:3, :3])
        return covariance

    def _state(self, evidence: Evidence) -> State:
        poses, first = self.poses, self.poses[0]
        if self.views[0].cam_from_rig is not None:  # one pose in the frame that the views share
            camera = cast(FloatArray, self.views[0].cam_from_rig)
            turn, shift = camera[:3, :3].T, first.translation - camera[:3, 3]
            poses = (Alignment(turn @ first.rotation, turn @ shift, first.scale),)
        packed = np.array([each.packed[:12] for each in poses])
        points = np.concatenate([self.points_3d, self.bounds])
        return State(packed, np.zeros(0), np.log(first.scale), *_explained(evidence.shape, points))


def _scene_of(
    model: Model | ShapeModel, views: tuple[View, ...], estimate: object, size: Size | None
) -> _KnownScene:
    """The scene of views, a size, and the estimate from them.

    Raises InputError if the estimate is neither an Alignment nor a Result, or lacks shape
    and all poses, or a view has a mask that is not of an exact model.
    """
    if not views:
        raise InputError("none is given", where="views")
    prior = prior_of(model)
    masked = [number for number, view in enumerate(views) if view.mask is not None]
    if masked and not is_exact_model(model):
        what = "the effect of a mask is predicted for an exact model only"
        fix = "leave it away, or give a Model without `shape_sigma`"
        raise InputError(what, where=f"views[{masked[0]}].mask", fix=fix)
    if isinstance(estimate, Alignment):
        poses = _poses_from(model, views, estimate)
        shape = prior.components[0].mean
        return _KnownScene(model, prior, views, poses, shape[:-2], shape[-2:], size)
    if not isinstance(estimate, Result):
        what = f"expected an Alignment or a Result, got {type(estimate).__name__}"
        raise InputError(what, where="estimate")
    if len(estimate.poses) != len(views):
        what = f"the estimate is from {len(estimate.poses)} views, given are {len(views)}"
        raise InputError(what, where="views", fix="give the views that it is from")
    own = replace(prior, components=(prior.components[estimate.component],), weights=(1.0,))
    points = np.asarray(estimate.points_3d)
    return _KnownScene(model, own, views, estimate.poses, points, estimate.bounds, size)


def _poses_from(
    model: Model | ShapeModel, views: Sequence[View], first: Alignment
) -> tuple[Alignment, ...]:
    fix = "give the Result of `align`"
    if not is_exact_model(model):
        raise InputError("an alignment does not tell the shape", where="estimate", fix=fix)
    if len(views) == 1:
        return (first,)
    cameras = [cast("FloatArray | None", view.cam_from_rig) for view in views]
    known = [each for each in cameras if each is not None]
    if len(known) < len(views):
        what = "an alignment does not tell the poses of the other views"
        raise InputError(what, where="estimate", fix=fix)
    steps = [camera @ np.linalg.inv(known[0]) for camera in known[1:]]
    return (first, *(Alignment(step[:3, :3], step[:3, 3], np.ones(3)) @ first for step in steps))


def _explained(shape: Shape, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The likeliest coefficients (K,) and displacements (m, 3) of a shape with these points."""
    rest = points - shape.mean
    weight = 1 / np.maximum(shape.spread, _LEAST_SPREAD)
    modes = shape.modes * weight[:, None]
    flat = modes.reshape(len(modes), points.size)
    normal = flat @ flat.T + np.eye(len(flat))
    coefficients = np.asarray(np.linalg.solve(normal, flat @ (rest * weight[:, None]).ravel()))
    left = rest - np.tensordot(coefficients, shape.modes, axes=1)
    return coefficients, np.asarray(np.where(shape.spread[:, None] > 0, left, 0.0))
