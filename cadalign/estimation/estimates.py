"""Likely estimates in terms of the result: covariances, boxes, and moments of their mixture.

If an outermost keypoint determines a face of the box, the face moves with it: the face's row of the
shape is the keypoint's row, shifted by the margin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.prior import ShapePrior
from cadalign.estimation.problem import Problem
from cadalign.estimation.symmetry import (
    distinct_alignments,
    remove_free_turns,
    transform_covariance,
)
from cadalign.estimation.uncertainty.residuals import loss_weights, whitening_matrices
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, rotate_alignment, rotate_covariance
from cadalign.geometry.pixels import perspective
from cadalign.geometry.rotations import by_rotation, vector_from_rotation
from cadalign.geometry.symmetry import Equal, Symmetry
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import Evidence, State, points_of
from cadalign.solvers.marginal.equations import POSE_UNKNOWNS
from cadalign.solvers.marginal.problem import Mixture, Seen, coordinates_of, shape_at
from cadalign.solvers.projection import ray_derivatives

_Held = tuple[bool, bool, bool]
_ALONG_AXES = 1e-6  # of a rotation's entries from 0 or 1, if it maps axes to axes


def mean_state(evidence: Evidence, poses: FloatArray, log_scales: FloatArray) -> State:
    """The state of the mean shape at poses (P, 12) and log scales (3,)."""
    shape, focals = evidence.shape, np.zeros(len(evidence.focals.low))
    still = np.zeros(len(shape.modes)), np.zeros_like(shape.mean)
    return State(poses, focals, log_scales, *still)


def pose_and_lengths(
    evidence: Evidence, state: State, unknowns: FloatArray, view: int = 0
) -> FloatArray:
    """Covariance (9, 9) of a camera's pose and log lengths; (10, 10) with the log focal length.

    ``unknowns`` is the covariance from `cadalign.solvers.joint.covariance.pose_and_border`.
    """
    shape, rig = evidence.shape, evidence.rig
    rotation = rig.cam_from_rig[view][:9].reshape(3, 3)
    group = int(evidence.focals.group[view])
    first = 6 + len(evidence.focals.low)
    rows = np.zeros((9 + (group >= 0), len(unknowns)))
    rows[:3, :3] = rotation
    rows[3:6, 3:6] = rotation
    if group >= 0:
        rows[9, 6 + group] = 1.0
    modes = shape.modes[:, -1] - shape.modes[:, -2]
    extent = shape.mean[-1] - shape.mean[-2] + state.coefficients @ modes
    safe = np.where(extent > 0, extent, np.inf)
    rows[6:9, first : first + 3] = np.eye(3)
    rows[6:9, first + 3 :] = (modes / safe).T
    # The weight of a measured length includes the variance ``own`` of the corners' displacements as
    # noise. So these explain a share of the length's residual.
    own = (shape.spread[-2:] ** 2).sum()
    offsets, explained = evidence.offsets, np.zeros(3)
    of_box = (offsets.ends == [len(shape.mean) - 2, len(shape.mean) - 1]).all(1)
    along = np.abs(offsets.direction[of_box]).argmax(axis=1)
    explained[along] = np.minimum(own * offsets.weight[of_box] ** 2, 1.0)
    rows[6:9] *= 1 - explained[:, None]
    covariance = np.asarray(rows @ unknowns @ rows.T)
    covariance[[6, 7, 8], [6, 7, 8]] += own * (1 - explained) / safe**2
    return covariance


def poses_of(evidence: Evidence, state: State) -> list[Alignment]:
    """Alignments in every view's camera."""
    rig, scale = evidence.rig, np.exp(state.log_scales)
    poses = []
    for camera, p in zip(rig.cam_from_rig, rig.pose, strict=True):
        rotation, pose = camera[:9].reshape(3, 3), state.poses[p]
        turned = rotation @ pose[:9].reshape(3, 3)
        poses.append(
            Alignment(turned, rotation @ pose[9:] + camera[9:], scale.copy(), is_valid=True)
        )
    return poses


def curvature_of_rotations(covariance: FloatArray) -> FloatArray:
    """Second-order covariance (3, 3) of large rotation errors [rad squared].

    For rotation vectors a and b, exp(a) exp(b) has the vector a + b + a x b / 2 + ... (Baker,
    Campbell, Hausdorff). For independent a and b of covariance C, the second-order term has the
    covariance adj(C) / 2. It matters beyond about 20 degrees.
    """
    variances, axes = np.linalg.eigh(covariance)
    x, y, z = np.maximum(variances, 0.0)
    return np.asarray((axes * [y * z, x * z, x * y]) @ axes.T / 2)


def estimate_box(evidence: Evidence, state: State, prior: ShapePrior) -> tuple[Evidence, State]:
    """Move the box's faces to the outermost keypoints that determine them.

    Measured distances determine the linear box, which then stays.
    """
    shape, keypoints = evidence.shape, len(prior.ids)
    seen = np.unique(evidence.sightings.point)
    seen = seen[seen < keypoints]
    if len(evidence.offsets.value) or not len(shape.modes) or not len(seen):
        return evidence, state
    points = points_of(shape, state) / np.exp(state.log_scales)
    bounds, own = place_box(points, keypoints, seen, prior)
    axes = np.arange(3)
    mean, modes = shape.mean.copy(), shape.modes.copy()
    displacements = state.displacements.copy()
    mean[-2:] = mean[own, axes] + (bounds - points[own, axes])
    modes[:, -2:] = modes[:, own, axes]
    displacements[-2:] = displacements[own, axes]
    placed = evidence._replace(shape=shape._replace(mean=mean, modes=modes))
    return placed, state._replace(displacements=displacements)


def place_box(
    points: FloatArray, keypoints: int, seen: IntArray, model: ShapePrior | ShapeModel
) -> tuple[FloatArray, IntArray]:
    """Corners (2, 3) of the box of points (m, 3), and rows (2, 3) of points that determine it.

    The last two points are the linear box. A ``model`` without a box has the keypoints' extent;
    otherwise margins select faces that ``seen`` keypoints determine.
    """
    linear, rows = points[-2:], seen if model.has_box else np.arange(keypoints)
    extreme = rows[np.array([points[rows].argmin(axis=0), points[rows].argmax(axis=0)])]
    if not model.has_box:
        return points[extreme, np.arange(3)], extreme
    own = np.broadcast_to(len(points) - np.array([[2], [1]]), (2, 3))
    if model.box_margins is None:
        return linear, own
    bounds = model.box_margins.bounds(linear, points[rows])
    return bounds, np.where(bounds != linear, extreme, own)


def enlarge_boxes(points: FloatArray, rows: IntArray) -> FloatArray:
    """Enlarge the box, the last two of points (..., m, 3), to contain the points ``rows``."""
    widened, seen = points.copy(), points[..., rows, :]
    widened[..., -2, :] = np.minimum(points[..., -2, :], seen.min(axis=-2, initial=np.inf))
    widened[..., -1, :] = np.maximum(points[..., -1, :], seen.max(axis=-2, initial=-np.inf))
    return widened


class Estimate(NamedTuple):
    """An estimate: points (m, 3), the box's corners last, poses, and covariances.

    Poses, covariances (9, 9) and cameras are given for each view that takes part, in the frames of
    the given cameras. ``points_covariance`` (m, 3, 3) are covariances of the points in the model's
    frame, ``points_cam_covariance`` in the first camera's frame, including the pose.
    """

    points: FloatArray
    scale: FloatArray
    poses: tuple[Alignment, ...]
    covariances: tuple[FloatArray, ...]
    points_covariance: FloatArray
    points_cam_covariance: FloatArray
    likelihood: float = 1.0
    cameras: tuple[Camera, ...] = ()
    is_optimum: bool = False

    @property
    def lengths(self) -> FloatArray:
        return np.asarray((self.points[-1] - self.points[-2]) * self.scale)


def undo_turns(estimate: Estimate, problem: Problem) -> Estimate:
    """Transform an estimate from turned cameras to the given cameras."""
    given = [problem.given[number].camera for number in problem.numbers]
    if given == [problem.views[number].camera for number in problem.numbers]:
        return estimate
    turns = [problem.turns[number] for number in problem.numbers]
    first = turns[0]
    return estimate._replace(
        poses=tuple(map(rotate_alignment, estimate.poses, turns)),
        covariances=tuple(map(rotate_covariance, estimate.covariances, turns)),
        points_cam_covariance=first @ estimate.points_cam_covariance @ first.T,
        cameras=tuple(
            camera if camera.is_wide else own
            for camera, own in zip(given, estimate.cameras, strict=True)
        ),
    )


def steps_between(estimates: Sequence[Estimate], view: int) -> FloatArray:
    """Steps (L, k) from the first estimate in a view's camera, with a covariance's unknowns."""
    best, *others = estimates
    steps: list[list[float]] = [[0.0] * 10]
    start, before = best.poses[view], [*best.lengths.tolist(), best.cameras[view].fx]
    for each in others:
        end, after = each.poses[view], [*each.lengths.tolist(), each.cameras[view].fx]
        turn = vector_from_rotation(end.rotation @ start.rotation.T)
        logs = [math.log(b / a) if a > 0 < b else 0.0 for a, b in zip(before, after, strict=True)]
        steps.append([*turn, *(end.translation - start.translation), *logs])
    return np.array(steps)[:, : len(best.covariances[view])]


def second_moments(
    estimates: Sequence[Estimate], covariances: Sequence[FloatArray], places: FloatArray
) -> FloatArray:
    """Second moments (..., k, k) of estimates at ``places`` (L, ..., k) about the first."""
    if len(estimates) == 1:
        return covariances[0].copy()
    weights = np.array([each.likelihood for each in estimates])
    gaps = places - places[0]
    squares = gaps[..., None] * gaps[..., None, :]
    return np.tensordot(weights / weights.sum(), np.array(covariances) + squares, axes=1)


def canonical_estimates(
    likely: Sequence[Estimate], symmetry: Symmetry | None, held: _Held
) -> Sequence[Estimate]:
    """Canonical estimates without duplicates of the first; ``held`` axes have a fixed scale."""
    if symmetry is None or symmetry.is_trivial:
        return likely
    poses, covariance = [each.poses[0] for each in likely], likely[0].covariances[0]
    found = distinct_alignments(poses, covariance, symmetry, held)
    return [_transform(likely[k], equal) for k, equal in found]


def _transform(estimate: Estimate, best: Equal) -> Estimate:
    turn, shift, scale = best.motion[:3, :3], best.motion[:3, 3], best.alignment.scale
    poses: list[Alignment] = []
    covariances = []
    for given, covariance in zip(estimate.poses, estimate.covariances, strict=True):
        pose = Alignment(given.rotation @ turn, given.translation + given.linear @ shift, scale)
        equal = replace(best, alignment=pose if poses else best.alignment)
        poses.append(equal.alignment)
        covariances.append(remove_free_turns(transform_covariance(covariance, given, equal), equal))
    points = best.map_points(estimate.points)
    entries = np.abs(turn)
    if (np.minimum(entries, 1 - entries) > _ALONG_AXES).any():
        points[-2:] = estimate.points[-2:]  # a turned box would not be axis-aligned
    else:
        points[-2:] = np.sort(points[-2:], axis=0)
    return estimate._replace(
        points=points,
        scale=scale,
        poses=tuple(poses),
        covariances=tuple(covariances),
        points_covariance=turn.T @ estimate.points_covariance @ turn,
    )


def linearise(
    points: FloatArray, pose: Alignment, seen: Seen
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted errors (2 n,), and their derivatives by points (2 n, 3 n) and pose (2 n, 6)."""
    count, matrices = len(points), whitening_matrices(seen.whitening)
    rays = perspective(points @ pose.linear.T + pose.translation)
    errors = (matrices @ (rays - seen.rays)[:, :, None])[:, :, 0]
    by_pose = matrices @ ray_derivatives(points, pose.vector)[:, :, :POSE_UNKNOWNS]
    weights = loss_weights((errors**2).sum(axis=1), seen.loss, seen.loss_scale)
    roots = np.sqrt(weights)[:, None]
    by_pose *= roots[..., None]
    blocks = np.zeros((count, 2, count, 3))  # a translation moves all points equally
    np.einsum("iaib->iab", blocks)[:] = by_pose[..., 3:] @ pose.linear
    rows = blocks.reshape(2 * count, 3 * count)
    return (roots * errors).ravel(), rows, by_pose.reshape(2 * count, POSE_UNKNOWNS)


def single_posterior(
    mixture: Mixture,
    component: int,
    seen: Seen,
    state: FloatArray,
    inflation: float,
    model: ShapeModel | None = None,
) -> Estimate:
    """The posterior at a state (D,) of a component; infinite if the pose is undetermined.

    ``inflation`` scales the prior's deviations. The box contains the seen keypoints.
    """
    count, m = len(seen.points), mixture.means.shape[1]
    rotation = state[:9].reshape(3, 3)
    pose = Alignment(rotation, state[9:12], np.ones(3), is_valid=True)
    points = shape_at(mixture, component, seen, state)
    prior, columns = inflation**2 * mixture.covariances[component], coordinates_of(seen)
    if model is not None:
        points[-2:], faces = place_box(points, len(model.ids), seen.points, model)
        own = np.append(np.arange(3 * m - 6), 3 * faces + np.arange(3))
        prior = prior[np.ix_(own, own)]
    boxed, still = enlarge_boxes(points, seen.points), np.ones(3)
    _, rows, jacobian = linearise(points[seen.points], pose, seen)
    # The last row is the difference of the box's corners.
    prior = np.concatenate([prior, prior[-3:] - prior[-6:-3]])
    prior = np.concatenate([prior, prior[:, -3:] - prior[:, -6:-3]], axis=1)
    across = prior[:, columns] @ rows.T  # covariance of points with residuals
    inverse = np.linalg.inv(rows @ across[columns] + np.eye(2 * count))
    weight = jacobian.T @ inverse
    try:
        root = np.linalg.inv(np.linalg.cholesky(weight @ jacobian))
    except np.linalg.LinAlgError:
        unknown = np.full((m, 3, 3), np.inf)
        return Estimate(boxed, still, (pose,), (np.full((9, 9), np.inf),), unknown, unknown)
    of_pose, solved = root.T @ root, across @ inverse
    by_steps = (-solved @ jacobian).reshape(m + 1, 3, POSE_UNKNOWNS)
    left = np.einsum("iaib->iab", prior.reshape(m + 1, 3, m + 1, 3))
    blocks = m + 1, 3, 2 * count
    left = left - solved.reshape(blocks) @ across.reshape(blocks).swapaxes(1, 2)
    whole = left + by_steps @ of_pose @ by_steps.swapaxes(1, 2)
    in_camera = rotation @ by_steps[:m]
    in_camera[..., :3] += by_rotation(points @ rotation.T)
    in_camera[..., 3:] += np.eye(3)
    of_seen = rotation @ left[:m] @ rotation.T + in_camera @ of_pose @ in_camera.swapaxes(1, 2)
    extent = points[-1] - points[-2]
    relative = np.where(extent > 0, 1.0 / np.where(extent > 0, extent, 1.0), 0.0)
    logs = np.concatenate([np.eye(POSE_UNKNOWNS), relative[:, None] * by_steps[m]])
    covariance = logs @ of_pose @ logs.T
    covariance[POSE_UNKNOWNS:, POSE_UNKNOWNS:] += relative[:, None] * relative * left[m]
    return Estimate(boxed, still, (pose,), (covariance,), whole[:m], of_seen)
