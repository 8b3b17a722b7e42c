"""Pieces of evidence: what each tells, how well it agrees with an estimate, what it contributes.

What a piece contributes is told by the deviations without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.estimates import pose_and_lengths
from cadalign.estimation.evidence_kinds import SIZE, kind_names
from cadalign.estimation.facing import turned_covariance
from cadalign.estimation.pack import SingleBasis
from cadalign.estimation.prior import has_scale_prior
from cadalign.estimation.uncertainty.summary import Contribution, EvidenceSummary, Uncertainty
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import (
    Evidence,
    Planes,
    Rig,
    Sightings,
    State,
    distances_of,
    kept_rows,
    log_focals_of,
    points_of,
)
from cadalign.solvers.joint.reduction import reduced

_OUTLIER = 8.0  # [sigma], of a depth: it is that of something else
_WEAKEST = 1e-12  # share of the information about an unknown that counts as none
_UNKNOWN_ROTATION_DEG = 120.0
_UNKNOWN_SCALE = 5.0


class Piece(NamedTuple):
    """A kind of evidence (see `cadalign.EvidenceSummary`) and its view."""

    kind: str
    view: int | None


def pieces_of(evidence: Evidence) -> list[Piece]:
    """All pieces, view by view."""
    rig, sightings = evidence.rig, evidence.sightings
    is_ray, is_keypoint = sightings.whitening.any(axis=1), sightings.whitening[:, 2] > 0
    measured = sightings.image[sightings.depths[:, 1] > 0]
    told = {
        "keypoints": sightings.image[is_keypoint],
        "mask": sightings.image[is_ray & ~is_keypoint],
        "depth": np.append(measured, evidence.planes.image),
        **{kind: _views_of_known(evidence, number) for number, kind in enumerate(kind_names())},
        "rig": np.flatnonzero(np.bincount(rig.pose)[rig.pose] > 1),
    }
    views = {kind: set(rows.tolist()) for kind, rows in told.items()}
    pieces = [
        Piece(kind, view) for view in range(len(rig.pose)) for kind in views if view in views[kind]
    ]
    if -1 in views[SIZE]:
        pieces.append(Piece(SIZE, None))
    return pieces


def _views_of_known(evidence: Evidence, kind: int) -> IntArray:
    """Views of the known directions and distances of a kind."""
    tables = (evidence.directions, evidence.offsets)
    return np.concatenate([each.image[each.kind == kind] for each in tables])


def _known_in(evidence: Evidence, piece: Piece) -> BoolArray:
    """Known directions, then distances, that belong to a piece."""
    number, view = kind_names().index(piece.kind), -1 if piece.view is None else piece.view
    tables = (evidence.directions, evidence.offsets)
    return np.concatenate([(each.kind == number) & (each.image == view) for each in tables])


def keypoints_in(evidence: Evidence, view: int) -> BoolArray:
    """Sightings (N,) of a view that tell both coordinates of a ray."""
    sightings = evidence.sightings
    return np.asarray((sightings.image == view) & (sightings.whitening[:, 2] > 0))


def contours_in(evidence: Evidence, view: int) -> BoolArray:
    """Sightings (N,) of a view that tell a ray along a contour's normal alone."""
    sightings = evidence.sightings
    is_contour = (sightings.whitening[:, 2] == 0) & sightings.whitening[:, :2].any(axis=1)
    return np.asarray((sightings.image == view) & is_contour)


def depths_in(evidence: Evidence, view: int) -> BoolArray:
    """Sightings (N,) of a view that tell a depth."""
    sightings = evidence.sightings
    return np.asarray((sightings.image == view) & (sightings.depths[:, 1] > 0))


def without(evidence: Evidence, state: State, piece: Piece) -> tuple[Evidence, State]:
    """The evidence without a piece, and a state of its unknowns.

    Without the known motion of its camera, a view has a pose of its own.
    """
    view = piece.view
    if view is None or piece.kind in kind_names():
        kept, count = ~_known_in(evidence, piece), len(evidence.directions.kind)
        directions = kept_rows(evidence.directions, kept[:count])
        offsets = kept_rows(evidence.offsets, kept[count:])
        return evidence._replace(directions=directions, offsets=offsets), state
    if piece.kind == "rig":
        return _unlinked(evidence, state, view)
    if piece.kind == "keypoints":
        return evidence._replace(sightings=_unseen(evidence, view)), state
    if piece.kind == "mask":
        kept = ~contours_in(evidence, view)
        return evidence._replace(sightings=kept_rows(evidence.sightings, kept)), state
    return _without_depth(evidence, view), state


def _unseen(evidence: Evidence, view: int) -> Sightings:
    """The sightings without a view's keypoints, whose depths stay."""
    hidden = keypoints_in(evidence, view)
    kept = ~hidden | depths_in(evidence, view)
    whitening = np.where(hidden[:, None], 0.0, evidence.sightings.whitening)
    return kept_rows(evidence.sightings._replace(whitening=whitening), kept)


def _without_depth(evidence: Evidence, view: int) -> Evidence:
    there = depths_in(evidence, view)
    depths = np.where(there[:, None], 0.0, evidence.sightings.depths)
    planes: Planes = kept_rows(evidence.planes, evidence.planes.image != view)
    sightings = evidence.sightings._replace(depths=depths)
    kept = ~there | sightings.whitening.any(axis=1)
    return evidence._replace(sightings=kept_rows(sightings, kept), planes=planes)


def _unlinked(evidence: Evidence, state: State, view: int) -> tuple[Evidence, State]:
    pose: IntArray = evidence.rig.pose.copy()
    own = state.poses[pose[view]]
    pose[view] = len(state.poses)
    rig = Rig(evidence.rig.cam_from_rig, pose)
    return evidence._replace(rig=rig), state._replace(poses=np.vstack([state.poses, own]))


def count_equations(evidence: Evidence) -> int:
    """Number of equations, those of priors included; what is exact adds none."""
    sightings = evidence.sightings
    count = 2 * int((sightings.whitening[:, 2] > 0).sum())
    count += int((sightings.whitening[sightings.whitening[:, 2] == 0].any(axis=1)).sum())
    count += int((sightings.depths[:, 1] > 0).sum())
    count += 2 * len(evidence.directions.image) + len(evidence.offsets.weight)
    count += len(evidence.planes.weight)
    count += len(evidence.shape.modes)
    if has_scale_prior(evidence.scales):
        count += int(np.linalg.matrix_rank(evidence.scales.precision))
    return count


def redundancy_of(evidence: Evidence) -> int:
    """Equations minus unknowns, where all of these are determined."""
    unknowns = 6 * int(evidence.rig.pose.max() + 1) + int(evidence.scales.free.sum())
    return count_equations(evidence) - len(evidence.shape.modes) - unknowns


def summaries_of(
    evidence: Evidence, state: State, cameras: Sequence[Camera]
) -> tuple[EvidenceSummary, ...]:
    """Root mean square residuals of all pieces but masks, view by view."""
    points = points_of(evidence.shape, state)
    found = []
    for piece in pieces_of(evidence):
        if piece.kind in kind_names():
            found.extend(_of_known(evidence, state, piece))
        elif piece.view is not None and piece.kind == "keypoints":
            camera = cameras[piece.view]
            found.append(_of_keypoints(evidence, state, points, piece.view, camera))
        elif piece.view is not None and piece.kind == "depth":
            found.append(_of_depths(evidence, state, points, piece.view))
    return tuple(found)


def seen_in_cameras(
    evidence: Evidence, state: State, points: FloatArray, image: IntArray
) -> FloatArray:
    """Points (N, 3) of the model in the cameras (N,) of views."""
    rig = evidence.rig
    for motion in (state.poses[rig.pose[image]], rig.cam_from_rig[image]):
        turned = np.einsum("nij,nj->ni", motion[:, :9].reshape(-1, 3, 3), points)
        points = turned + motion[:, 9:]
    return points


def _of_keypoints(
    evidence: Evidence, state: State, points: FloatArray, view: int, camera: Camera
) -> EvidenceSummary:
    sightings, rows = evidence.sightings, keypoints_in(evidence, view)
    seen = seen_in_cameras(evidence, state, points[sightings.point[rows]], _numbers(rows, view))
    log_ratio = log_focals_of(evidence, state)[view]
    ratio = np.exp(log_ratio)
    seen_rays = seen[:, :2] / seen[:, 2:]
    errors = seen_rays - (sightings.rays[rows] + log_ratio * sightings.slopes[rows]) / ratio
    whitening = ratio * sightings.whitening[rows]
    return summary_of_keypoints(errors, seen_rays, whitening, view, camera)


def summary_of_keypoints(
    errors: FloatArray, rays: FloatArray, whitening: FloatArray, view: int, camera: Camera
) -> EvidenceSummary:
    """The summary of errors (n, 2) of rays (n, 2), with their whitening (n, 3)."""
    a, b, c = whitening.T
    whitened = np.hypot(a * errors[:, 0] + b * errors[:, 1], c * errors[:, 1])
    bent = np.einsum("nij,nj->ni", camera.distortion_jacobian(rays), errors)
    in_pixels = np.hypot(*(bent * (camera.fx, camera.fy)).T)
    return _summary("keypoints", view, in_pixels, whitened, "px", 2)


def _of_depths(evidence: Evidence, state: State, points: FloatArray, view: int) -> EvidenceSummary:
    expected, measured, weights = _depths(evidence, state, points, view)
    errors = expected - measured
    counted = np.abs(errors * weights) < _OUTLIER
    if not counted.any():
        counted[:] = True
    return _summary("depth", view, errors[counted], (errors * weights)[counted], "")


def measured_factor(evidence: Evidence, state: State, piece: Piece) -> float | None:
    """Median of a piece's measured over expected depths or distances; None where it has none."""
    points = points_of(evidence.shape, state)
    if piece.kind == "depth" and piece.view is not None:
        expected, measured, _ = _depths(evidence, state, points, piece.view)
    elif piece.kind in kind_names():
        rows = _known_in(evidence, piece)[len(evidence.directions.kind) :]
        offsets = kept_rows(evidence.offsets, rows)
        expected = distances_of(evidence._replace(offsets=offsets), state.poses, points)
        measured = offsets.value
    else:
        return None
    return float(np.median(measured / expected)) if len(measured) else None


def _depths(
    evidence: Evidence, state: State, points: FloatArray, view: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Expected and measured depths of a view (n,), with the inverse deviations."""
    sightings, rows = evidence.sightings, depths_in(evidence, view)
    seen = seen_in_cameras(evidence, state, points[sightings.point[rows]], _numbers(rows, view))
    expected, measured, weights, images = plane_distances(evidence, state)
    others = images == view
    return (
        np.concatenate([seen[:, 2], expected[others]]),
        np.concatenate([sightings.depths[rows, 0], measured[others]]),
        np.concatenate([sightings.depths[rows, 1], weights[others]]),
    )


def plane_distances(
    evidence: Evidence, state: State
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Expected and measured depths at which rays meet planes, inverse deviations, and views."""
    planes = evidence.planes
    points = points_of(evidence.shape, state)[planes.point]
    seen = seen_in_cameras(evidence, state, points, planes.image)
    ratios = np.exp(log_focals_of(evidence, state))[planes.image]
    rays = np.column_stack([planes.ray / ratios[:, None], np.ones(len(ratios))])
    met = (seen * planes.normal).sum(axis=1) / (rays * planes.normal).sum(axis=1)
    return met, planes.depth, planes.weight, planes.image


def _of_known(evidence: Evidence, state: State, piece: Piece) -> list[EvidenceSummary]:
    """The summaries of a piece's known directions and distances."""
    rows, count = _known_in(evidence, piece), len(evidence.directions.kind)
    found = []
    directions = kept_rows(evidence.directions, rows[:count])
    if len(directions.kind):
        origin = seen_in_cameras(evidence, state, 0.0 * directions.model, directions.image)
        seen = seen_in_cameras(evidence, state, directions.model, directions.image)
        differences = seen - origin - directions.camera
        whitened = np.einsum("nij,nj->ni", directions.whitening, differences)
        halves = np.minimum(np.linalg.norm(differences, axis=1) / 2, 1.0)
        angles = np.degrees(2 * np.arcsin(halves))
        found.append(_summary(*piece, angles, np.linalg.norm(whitened, axis=1), "deg", 2))
    offsets = kept_rows(evidence.offsets, rows[count:])
    if len(offsets.kind):
        points = points_of(evidence.shape, state)
        measured = evidence._replace(offsets=offsets)
        errors = distances_of(measured, state.poses, points) - offsets.value
        found.append(_summary(*piece, errors, errors * offsets.weight, ""))
    return found


def _numbers(rows: BoolArray, view: int) -> IntArray:
    return np.full(int(rows.sum()), view)


def _summary(
    kind: str,
    view: int | None,
    errors: FloatArray,
    whitened: FloatArray,
    unit: str,
    equations: int = 1,
) -> EvidenceSummary:
    """The summary of residuals (n,) and their lengths in sigmas, of so many equations each."""
    count = len(errors)
    in_sigmas = np.sqrt((whitened * whitened).sum() / (equations * count))
    return EvidenceSummary(
        kind, view, count, float(in_sigmas), float(np.sqrt((errors * errors).mean())), unit
    )


@dataclass(frozen=True, eq=False)
class Basis:
    """The evidence in the form of the kernels, and the state that was estimated from it.

    ``numbers`` are those of its views among all that were given; None where all are used.
    ``turn`` (3, 3) leads from the first view's frame to that of the result, where it is another.
    ``photos`` numbers the views whose contour is that of a photo. ``principal_sigma`` [px] is the
    prior's standard deviation where the principal point was estimated, too.
    """

    evidence: Evidence
    state: State
    numbers: tuple[int, ...] | None = None
    turn: FloatArray | None = None
    photos: frozenset[int] = frozenset()
    principal_sigma: float | None = None


AnyBasis = Basis | SingleBasis
"""What contributions are computed from."""


def contributions_of(basis: AnyBasis) -> tuple[Contribution, ...]:
    """Deviations at the estimate without each piece."""
    found = []
    for piece in pieces_of(basis.evidence):
        rest, state = without(basis.evidence, basis.state, piece)
        view, kind = piece.view, piece.kind
        if kind == "mask" and view in basis.photos:
            kind = "photo"
        if view is not None and basis.numbers is not None:
            view = basis.numbers[view]
        found.append(Contribution(kind, view, _deviations(rest, state, basis.turn)))
    return tuple(found)


def _deviations(evidence: Evidence, state: State, turn: FloatArray | None) -> Uncertainty:
    evidence, state = reduced(evidence, state)  # displacements of several views are modes
    _, information = information_of(evidence, state)
    sizes = np.sqrt(information.diagonal())
    sizes[~(sizes > 0)] = _WEAKEST  # nothing is known of it
    scaled = information / np.outer(sizes, sizes)
    inverse = np.linalg.inv(scaled + _WEAKEST * np.eye(len(sizes)))
    covariance = inverse / np.outer(sizes, sizes)
    first = len(sizes) - len(evidence.shape.modes) - 3
    held = first + np.flatnonzero(evidence.scales.free == 0)
    covariance[held] = covariance[:, held] = 0.0
    pose, border = 6 * int(evidence.rig.pose[0]), 6 * len(state.poses)
    shown = [*range(pose, pose + 6), *range(border, len(covariance))]
    of_all = pose_and_lengths(evidence, state, covariance[np.ix_(shown, shown)])
    if turn is not None:
        of_all = turned_covariance(of_all, turn)
    deviations = np.sqrt(np.maximum(of_all.diagonal(), 0.0))
    distance = float(np.linalg.norm(state.poses[evidence.rig.pose[0], 9:]))
    rotation = float(np.degrees(np.linalg.norm(deviations[:3])))
    x, y, z = (_or_infinite(each, _UNKNOWN_SCALE * distance) for each in deviations[3:6])
    sx, sy, sz = (_or_infinite(each, _UNKNOWN_SCALE) for each in deviations[6:9])
    focal = _or_infinite(float(deviations[9:].sum()), _UNKNOWN_SCALE)  # none where it is known
    return Uncertainty(
        _or_infinite(rotation, _UNKNOWN_ROTATION_DEG), (x, y, z), (sx, sy, sz), focal
    )


def _or_infinite(deviation: float, limit: float) -> float:
    return float(deviation) if deviation < limit else float("inf")
