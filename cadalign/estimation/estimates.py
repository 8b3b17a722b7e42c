"""Likely estimates in the terms of the result: stretch, box, covariance of what is asked for.

All of them together are a mixture of Gaussians; of those that are equal under the model's symmetry
one stands for all. A face of the box that an outermost keypoint determines moves with it: its row
of the shape becomes that of the keypoint, shifted by the margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.symmetry import SAME_SQUARES, carried, is_same, without_free_turns
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.geometry.symmetry_group import Equal, group_of
from cadalign.shapes.box_margins import BoxMargins
from cadalign.solvers.joint.covariance import JointCovariance
from cadalign.solvers.joint.evidence import Evidence, State, points_of
from cadalign.solvers.marginal.equations import force_of
from cadalign.solvers.marginal.moments import Likely, Moments, moments_of
from cadalign.solvers.marginal.problem import Mixture, Seen, shape_at
from cadalign.solvers.search import Minima

Held = tuple[bool, bool, bool]
_ALONG_AXES = 1e-6  # of a rotation's entries, that are 0 or 1 where it takes axes to axes


class Estimate(NamedTuple):
    """An estimate: points, the box's corners last, ``lengths`` of the box, covariances.

    Poses and covariances (9, 9) are those in every view.
    """

    points: FloatArray
    scale: FloatArray
    poses: tuple[Alignment, ...]
    lengths: FloatArray
    covariances: tuple[FloatArray, ...]
    of_points: FloatArray
    of_seen: FloatArray
    likelihood: float
    cameras: tuple[Camera, ...]

    @property
    def covariance(self) -> FloatArray:
        """In the first view."""
        return self.covariances[0]


def stretch_of(lengths: FloatArray, of_mean: FloatArray) -> FloatArray:
    """Lengths (3,) over those of the mean; 1 where it has none."""
    has_length = of_mean > 0
    return np.where(has_length, lengths / np.where(has_length, of_mean, 1.0), 1.0)


def moments_of_estimates(estimates: Sequence[Estimate], view: int = 0) -> Moments:
    """Second moments of estimates about the first, in a view's camera; of points in the first."""
    poses = [
        np.concatenate([each.poses[view].rotation.ravel(), each.poses[view].translation])
        for each in estimates
    ]
    return moments_of(
        Likely(
            np.array(poses),
            np.array([each.points * each.scale for each in estimates]),
            np.array([_lengths_and_focal(each, view) for each in estimates]),
            np.array([each.covariances[view] for each in estimates]),
            np.array([each.of_points for each in estimates]),
            np.array([each.of_seen for each in estimates]),
            np.array([each.likelihood for each in estimates]),
        )
    )


def _lengths_and_focal(estimate: Estimate, view: int) -> FloatArray:
    """Lengths (3,) of the box and, where its covariance has it, the focal length of a view."""
    focal = [estimate.cameras[view].fx]
    return np.append(estimate.lengths, focal[: len(estimate.covariances[view]) - 9])


def is_other(moments: Moments, k: int) -> bool:
    """True if an estimate is not the first one within its deviations."""
    return bool(moments.distances[k] > SAME_SQUARES)


def one_of_equals(
    likely: Sequence[Estimate], symmetry: Symmetry | None, held: Held
) -> list[Estimate]:
    """Estimates in their canonical form, without those that are equal to the first.

    ``held`` are the axes whose scale is.
    """
    if symmetry is None or group_of(symmetry).is_trivial:
        return list(likely)
    group = group_of(symmetry)
    found = [canonical(each, symmetry, held) for each in likely]
    best = found[0]
    return [best] + [
        each
        for each in found[1:]
        if not is_same(group, best.poses[0], each.poses[0], best.covariance)
    ]


def canonical(estimate: Estimate, symmetry: Symmetry, held: Held) -> Estimate:
    """The canonical one of all equal estimates, without deviations that mean nothing."""
    best = group_of(symmetry).canonical(estimate.poses[0], held=held)
    turn = best.motion[:3, :3]
    poses = (best.alignment, *(_turned(pose, best) for pose in estimate.poses[1:]))
    covariances = []
    for given, pose, covariance in zip(estimate.poses, poses, estimate.covariances, strict=True):
        equal = replace(best, alignment=pose)
        covariances.append(without_free_turns(carried(covariance, given, equal), equal))
    points = best.relabelled(estimate.points)
    points[-2:] = _turned_box(estimate.points[-2:], best)
    return estimate._replace(
        points=points,
        scale=best.alignment.scale,
        poses=poses,
        lengths=(points[-1] - points[-2]) * best.alignment.scale,
        covariances=tuple(covariances),
        of_points=turn.T @ estimate.of_points @ turn,
    )


def _turned(pose: Alignment, best: Equal) -> Alignment:
    """An alignment in another view after the symmetry's motion."""
    shift = pose.translation + pose.linear @ best.motion[:3, 3]
    return Alignment(pose.rotation @ best.motion[:3, :3], shift, best.alignment.scale)


def _turned_box(corners: FloatArray, best: Equal) -> FloatArray:
    """Corners (2, 3) of the object's box; a box that leaves the axes stays as the symmetric is."""
    entries = np.abs(best.motion[:3, :3])
    if (np.minimum(entries, 1 - entries) > _ALONG_AXES).any():
        return corners
    return np.sort(best.relabelled(corners), axis=0)


def pose_and_border(found: JointCovariance, pose: int) -> FloatArray:
    """Covariance (6 + b, 6 + b) of one pose and of the unknowns that all views share."""
    cross = found.cross[pose]
    return np.block([[found.poses[pose], cross], [cross.T, found.border]])


def pose_and_lengths(
    evidence: Evidence, state: State, unknowns: FloatArray, view: int = 0
) -> FloatArray:
    """Covariance (9, 9) of a camera's pose and the log lengths of the box.

    With an estimated focal length (10, 10), its logarithm last. ``unknowns`` is the covariance of
    the view's pose and the border, see `pose_and_border`.
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
    own = (shape.spread[-2:] ** 2).sum()
    explained = _explained_by_corners(evidence, own)
    rows[6:9] *= 1 - explained[:, None]
    covariance = np.asarray(rows @ unknowns @ rows.T)
    covariance[[6, 7, 8], [6, 7, 8]] += own * (1 - explained) / safe**2
    return covariance


def _explained_by_corners(evidence: Evidence, own: float) -> FloatArray:
    """Share (3,) of a measured length's residual that the corners' own displacements explain.

    The weight of a length counts these, of variance ``own``, as part of its noise.
    """
    explained = np.zeros(3)
    explained[evidence.lengths.axis] = np.minimum(own * evidence.lengths.weight**2, 1.0)
    return explained


def widened(evidence: Evidence, state: State, factor: float) -> tuple[Evidence, State]:
    """The same points under a prior of wider deviations."""
    if factor == 1:
        return evidence, state
    shape = evidence.shape
    wide = shape._replace(modes=factor * shape.modes, spread=factor * shape.spread)
    return evidence._replace(shape=wide), state._replace(coefficients=state.coefficients / factor)


def is_exact(evidence: Evidence) -> bool:
    """True if the shape is known but for its scales."""
    return not (len(evidence.shape.modes) or evidence.shape.spread.any())


def curvature_of_rotations(covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) that a linearisation leaves out of large rotation errors.

    Where turns about two axes are uncertain, their order turns the object about the third: of
    rotation vectors a and b, exp(a) exp(b) has the vector a + b + a x b / 2 + ... (Baker, Campbell,
    Hausdorff). For independent a and b of covariance C the second-order term has the covariance
    adj(C) / 2. It matters beyond some 20 degrees: for slender objects, which may roll and tilt.

    Parameters
    ----------
    covariance : (3, 3) float
        Of the rotation vector [rad squared].

    Examples
    --------
    >>> curvature_of_rotations(np.diag([0.01, 0.25, 0.64])).diagonal().round(4).tolist()
    [0.08, 0.0032, 0.0012]
    """
    variances, axes = np.linalg.eigh(covariance)
    x, y, z = np.maximum(variances, 0.0)
    return np.asarray((axes * [y * z, x * z, x * y]) @ axes.T / 2)


def with_box(
    evidence: Evidence, state: State, keypoints: int, margins: BoxMargins
) -> tuple[Evidence, State]:
    """Evidence and state whose box has those faces that outermost keypoints determine at these.

    Such a face varies with its keypoint. The box remains the linear one where measured lengths or
    heights determine it.
    """
    shape = evidence.shape
    if len(evidence.lengths.value) or len(evidence.heights.value) or not len(shape.modes):
        return evidence, state
    points = points_of(shape, state) / np.exp(state.log_scales)
    rows = np.unique(evidence.sightings.point)
    rows = rows[rows < keypoints]
    bounds = margins.bounds(points[-2:], points[rows])
    mean, modes = shape.mean.copy(), shape.modes.copy()
    displacements = state.displacements.copy()
    outermost = rows[np.array([points[rows].argmin(axis=0), points[rows].argmax(axis=0)])]
    for face, axis in np.argwhere(bounds != points[-2:]).tolist():
        row, own = face - 2, outermost[face, axis]
        mean[row, axis] = mean[own, axis] + bounds[face, axis] - points[own, axis]
        modes[:, row, axis] = modes[:, own, axis]
        displacements[row, axis] = displacements[own, axis]
    placed = evidence._replace(shape=shape._replace(mean=mean, modes=modes))
    return placed, state._replace(displacements=displacements)


def with_boxes(
    mixture: Mixture, seen: Seen, minima: Minima, count: int, margins: BoxMargins
) -> tuple[Mixture, Minima]:
    """A component for each of the first minima, with the box that `with_box` gives."""
    if not mixture.covariances.any():
        return mixture, minima
    component = minima.label[:count]
    means, covariances = mixture.means[component], mixture.covariances[component]
    rows, axes = np.unique(seen.points), np.arange(3)
    box = 3 * means.shape[1] - np.arange(6, 0, -1).reshape(2, 3)
    for k in range(count):
        points = shape_at(mixture, component[k], seen, force_of(minima.states[k]))
        bounds = margins.bounds(points[-2:], points[rows])
        determined = bounds != points[-2:]
        outermost = rows[np.array([points[rows].argmin(axis=0), points[rows].argmax(axis=0)])]
        own = np.where(determined, 3 * outermost + axes, box)
        means[k, -2:] = means[k].ravel()[own]
        means[k, -2:] += np.where(determined, bounds - points[outermost, axes], 0.0)
        covariances[k, box.ravel()] = covariances[k, own.ravel()]
        covariances[k, :, box.ravel()] = covariances[k, :, own.ravel()]
    numbers = np.arange(count, dtype=minima.label.dtype)
    placed = Mixture(means, covariances, mixture.penalties[component])
    return placed, minima._replace(label=numbers)
