"""Evidence on an object at the state of an estimate: deviations of evidence that agrees."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.fitting.joint.boxes import with_box
from cadalign.fitting.joint.deviations import (
    curvature_of_rotations,
    is_exact,
    pose_and_lengths,
    widened,
)
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.pack import evidence_of
from cadalign.fitting.joint.prior import ShapePrior, prior_of
from cadalign.fitting.joint.result import AlignResult
from cadalign.fitting.joint.size import Size
from cadalign.fitting.joint.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import Evidence, Shape, State

_LEAST_SPREAD = 1e-6  # of points whose displacements a shape leaves out [model units]


@dataclass(frozen=True, eq=False)
class KnownScene:
    """Views of an object whose pose, stretch and shape are taken as known.

    Parameters
    ----------
    model : Model or ShapeModel
    prior : ShapePrior
        Its one component is that of the object.
    views : tuple of View
    poses : tuple of Alignment
        The alignment in every view's camera.
    points_3d : (m, 3) float
        Keypoints before the stretch.
    bounds : (2, 3) float
    size : Size, optional
    """

    model: Model | ShapeModel
    prior: ShapePrior
    views: tuple[View, ...]
    poses: tuple[Alignment, ...]
    points_3d: FloatArray
    bounds: FloatArray
    size: Size | None

    def with_view(self, added: tuple[View, Alignment]) -> KnownScene:
        """The scene with one more view and the alignment in its camera."""
        view, pose = added
        return replace(self, views=(*self.views, view), poses=(*self.poses, pose))

    def points_of(self, ids: Sequence[Hashable], where: str = "ids") -> FloatArray:
        """Keypoints (n, 3) by their ids."""
        return np.asarray(self.points_3d[self.prior.rows_of(tuple(ids), where)])

    def project(self, ids: Sequence[Hashable], number: int, where: str) -> FloatArray:
        """Places (n, 2) of keypoints in a view [px]."""
        seen = self.poses[number].apply(self.points_of(ids, where))
        return self.views[number].camera.project(seen)

    def covariance(self) -> FloatArray:
        """Covariance (9, 9) of an estimate, as `AlignResult.covariance`, linearised."""
        evidence = evidence_of(self.prior, self.views, self.size, loss=LINEAR, loss_scale=1.0)
        evidence, state = self._widened(evidence, self._state(evidence))
        own = evidence
        if isinstance(self.model, Model) and any(view.mask is not None for view in self.views):
            from cadalign.fitting.contours.bound import with_contours  # with OpenCV and embree

            evidence, state = with_contours(self.model, self.views, evidence, state)
        covariance = pose_and_lengths(evidence, state, joint_covariance(evidence, state).unknowns)
        symmetry = self.model.symmetry if isinstance(self.model, Model) else None
        if symmetry is None and not is_exact(own):
            covariance[:3, :3] += curvature_of_rotations(covariance[:3, :3])
        return covariance

    def _widened(self, evidence: Evidence, state: State) -> tuple[Evidence, State]:
        """With the deviations and the box that results state of a learned shape."""
        evidence, state = widened(evidence, state, self.prior.inflation)
        if self.prior.box_margins is None:
            return evidence, state
        return with_box(evidence, state, len(self.points_3d), self.prior.box_margins)

    def _state(self, evidence: Evidence) -> State:
        poses = [np.append(each.rotation.ravel(), each.translation) for each in self._free_poses()]
        log_scales = np.log(self.poses[0].scale)
        points = np.concatenate([self.points_3d, self.bounds])
        coefficients, rest = _explained(evidence.shape, points)
        return State(np.array(poses), log_scales, coefficients, rest * self.poses[0].scale)

    def _free_poses(self) -> tuple[Alignment, ...]:
        """One for every view, or one in the frame that the views share."""
        if self.views[0].cam_from_rig is None:
            return self.poses
        camera, pose = cast(FloatArray, self.views[0].cam_from_rig), self.poses[0]
        turn, shift = camera[:3, :3].T, pose.translation - camera[:3, 3]
        return (Alignment(turn @ pose.rotation, turn @ shift, pose.scale),)


def scene_of(
    model: Model | ShapeModel,
    views: tuple[View, ...],
    estimate: object,
    size: Size | None,
) -> KnownScene:
    """The scene of views, a size, and the estimate from them.

    Raises
    ------
    InputError
        If the estimate is neither an Alignment nor an AlignResult, or does not tell shape and all
        poses, or a view has a mask that is not of an exact model.
    """
    if not views:
        raise InputError("none is given", where="views")
    prior = prior_of(model)
    _check_masks(model, views)
    if isinstance(estimate, Alignment):
        poses = _poses_from(model, views, estimate)
        shape = prior.components[0].mean
        return KnownScene(model, prior, views, poses, shape[:-2], shape[-2:], size)
    if not isinstance(estimate, AlignResult):
        what = f"expected an Alignment or an AlignResult, got {type(estimate).__name__}"
        raise InputError(what, where="estimate")
    if len(estimate.poses) != len(views):
        what = f"the estimate is from {len(estimate.poses)} views, given are {len(views)}"
        raise InputError(what, where="views", fix="give the views that it is from")
    own = replace(prior, components=(prior.components[estimate.component],), weights=(1.0,))
    points = np.asarray(estimate.points_3d)
    return KnownScene(model, own, views, estimate.poses, points, estimate.bounds, size)


def _check_masks(model: Model | ShapeModel, views: Sequence[View]) -> None:
    if isinstance(model, Model) and model.shape_sigma is None:
        return
    masked = [number for number, view in enumerate(views) if view.mask is not None]
    if masked:
        what = "the effect of a mask is predicted for an exact model only"
        fix = "leave it away, or give a Model without `shape_sigma`"
        raise InputError(what, where=f"views[{masked[0]}].mask", fix=fix)


def _poses_from(
    model: Model | ShapeModel, views: Sequence[View], first: Alignment
) -> tuple[Alignment, ...]:
    """Poses in every camera from that in the first."""
    fix = "give the AlignResult of `align`"
    if isinstance(model, ShapeModel) or model.shape_sigma is not None:
        raise InputError("an alignment does not tell the shape", where="estimate", fix=fix)
    if len(views) == 1:
        return (first,)
    cameras = [cast("FloatArray | None", view.cam_from_rig) for view in views]
    known = [each for each in cameras if each is not None]
    if len(known) < len(views):
        what = "an alignment does not tell the poses of the other views"
        raise InputError(what, where="estimate", fix=fix)
    steps = [camera @ np.linalg.inv(known[0]) for camera in known[1:]]
    others = [
        Alignment(
            step[:3, :3] @ first.rotation,
            step[:3, :3] @ first.translation + step[:3, 3],
            first.scale,
        )
        for step in steps
    ]
    return (first, *others)


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
