"""Pieces of evidence: the rows of each, how well it agrees with an estimate, what it contributes.

What a piece contributes is told by the standard deviations without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.estimation.estimates import pose_and_lengths
from cadalign.estimation.pack import SingleBasis
from cadalign.estimation.prior import has_scale_prior
from cadalign.estimation.uncertainty.summary import (
    Contribution,
    EvidenceSummary,
    Uncertainty,
    uncertainty_of,
)
from cadalign.geometry.camera import Camera, turned_covariance
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import (
    Evidence,
    Rig,
    Sightings,
    State,
    distances_of,
    kept_rows,
    log_focals_of,
    points_of,
)
from cadalign.solvers.joint.search import reduced

_OUTLIER = 8.0  # [sigma], of a depth: it is that of something else
_WEAKEST = 1e-12  # share of the information about an unknown that counts as none
_UNKNOWN_ROTATION_DEG = 120.0
_UNKNOWN_SCALE = 5.0


class Piece(NamedTuple):
    """A kind of evidence (see `cadalign.EvidenceSummary`) and its view."""

    kind: str
    view: int | None


def told_by(sightings: Sightings) -> dict[str, BoolArray]:
    """Sightings (N,) of a keypoint's ray, of a ray along a contour's normal alone, of a depth."""
    is_keypoint = sightings.whitening[:, 2] > 0
    is_contour = (sightings.whitening[:, 2] == 0) & sightings.whitening.any(axis=1)
    return {"keypoints": is_keypoint, "mask": is_contour, "depth": sightings.depths[:, 1] > 0}


def pieces_of(evidence: Evidence) -> list[Piece]:
    """All pieces, view by view."""
    rig, offsets = evidence.rig, evidence.offsets
    told = {kind: evidence.sightings.image[on] for kind, on in told_by(evidence.sightings).items()}
    told["depth"] = np.append(told["depth"], evidence.image_depths.image)
    told["gravity"] = evidence.directions.image
    told["camera height"] = offsets.image[offsets.image >= 0]
    told["rig"] = np.flatnonzero(np.bincount(rig.pose)[rig.pose] > 1)
    views = {kind: set(rows.tolist()) for kind, rows in told.items()}
    pieces = [
        Piece(kind, view) for view in range(len(rig.pose)) for kind in views if view in views[kind]
    ]
    if (offsets.image < 0).any():
        pieces.append(Piece("size", None))
    return pieces


def _offsets_of(evidence: Evidence, piece: Piece) -> BoolArray:
    """Known distances (L,) that belong to a piece: the size, or a camera's height."""
    return np.asarray(evidence.offsets.image == (-1 if piece.view is None else piece.view))


def without(evidence: Evidence, state: State, piece: Piece) -> tuple[Evidence, State]:
    """The evidence without a piece, and a state of its unknowns.

    Without the known motion of its camera, a view has a pose of its own.
    """
    kind, view, sightings = piece.kind, piece.view, evidence.sightings
    if view is None or kind == "camera height":
        offsets = kept_rows(evidence.offsets, ~_offsets_of(evidence, piece))
        return evidence._replace(offsets=offsets), state
    if kind == "gravity":
        directions = kept_rows(evidence.directions, evidence.directions.image != view)
        return evidence._replace(directions=directions), state
    if kind == "rig":
        pose: IntArray = evidence.rig.pose.copy()
        own = state.poses[pose[view]]
        pose[view] = len(state.poses)
        rig = Rig(evidence.rig.cam_from_rig, pose)
        return evidence._replace(rig=rig), state._replace(poses=np.vstack([state.poses, own]))
    hidden = told_by(sightings)[kind] & (sightings.image == view)
    if kind == "depth":
        depths = kept_rows(evidence.image_depths, evidence.image_depths.image != view)
        evidence = evidence._replace(image_depths=depths)
        sightings = sightings._replace(depths=np.where(hidden[:, None], 0.0, sightings.depths))
    else:
        whitening = np.where(hidden[:, None], 0.0, sightings.whitening)
        sightings = sightings._replace(whitening=whitening)
    kept = ~hidden | np.any(list(told_by(sightings).values()), axis=0)
    return evidence._replace(sightings=kept_rows(sightings, kept)), state


def count_equations(evidence: Evidence) -> int:
    """Number of equations, those of priors included; what is exact adds none."""
    told = {kind: int(rows.sum()) for kind, rows in told_by(evidence.sightings).items()}
    count = 2 * told["keypoints"] + told["mask"] + told["depth"]
    count += 2 * len(evidence.directions.image) + len(evidence.offsets.weight)
    count += len(evidence.image_depths.weight) + len(evidence.shape.modes)
    if has_scale_prior(evidence.scales):
        count += int(np.linalg.matrix_rank(evidence.scales.precision))
    return count


def redundancy_of(evidence: Evidence) -> int:
    """Equations minus unknowns, where all of these are determined."""
    unknowns = 6 * int(evidence.rig.pose.max() + 1) + int(evidence.scales.free.sum())
    return count_equations(evidence) - len(evidence.shape.modes) - unknowns


# Agreement ---------------------------------------------------------------------------------------


def summaries_of(
    evidence: Evidence, state: State, cameras: Sequence[Camera]
) -> tuple[EvidenceSummary, ...]:
    """Root mean square residuals of all pieces but masks, view by view."""
    found = []
    for piece in pieces_of(evidence):
        if piece.view is None or piece.kind == "camera height":
            found.append(_of_distances(evidence, state, piece))
        elif piece.kind == "gravity":
            found.append(_of_gravity(evidence, state, piece.view))
        elif piece.kind == "keypoints":
            found.append(_of_keypoints(evidence, state, piece.view, cameras[piece.view]))
        elif piece.kind == "depth":
            expected, measured, weights = _depths(evidence, state, piece.view)
            errors = expected - measured
            counted = np.abs(errors * weights) < _OUTLIER
            if not counted.any():
                counted[:] = True
            found.append(_summary(*piece, errors[counted], (errors * weights)[counted], ""))
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


def _sighted(evidence: Evidence, state: State, rows: BoolArray) -> FloatArray:
    """Points (n, 3) of some sightings in their cameras."""
    points = points_of(evidence.shape, state)[evidence.sightings.point[rows]]
    return seen_in_cameras(evidence, state, points, evidence.sightings.image[rows])


def _of_keypoints(evidence: Evidence, state: State, view: int, camera: Camera) -> EvidenceSummary:
    sightings = evidence.sightings
    rows = told_by(sightings)["keypoints"] & (sightings.image == view)
    seen = _sighted(evidence, state, rows)
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


def measured_factor(evidence: Evidence, state: State, piece: Piece) -> float | None:
    """Median of a piece's measured over expected depths or distances; None where it has none."""
    if piece.kind == "depth" and piece.view is not None:
        expected, measured, _ = _depths(evidence, state, piece.view)
    elif piece.view is None or piece.kind == "camera height":
        expected, measured, _ = _distances(evidence, state, piece)
    else:
        return None
    return float(np.median(measured / expected)) if len(measured) else None


def _depths(
    evidence: Evidence, state: State, view: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Expected and measured depths of a view (n,), with the inverse standard deviations."""
    sightings = evidence.sightings
    rows = told_by(sightings)["depth"] & (sightings.image == view)
    expected, others = image_depths_at(evidence, state), evidence.image_depths.image == view
    return (
        np.concatenate([_sighted(evidence, state, rows)[:, 2], expected[others]]),
        np.concatenate([sightings.depths[rows, 0], evidence.image_depths.value[others]]),
        np.concatenate([sightings.depths[rows, 1], evidence.image_depths.weight[others]]),
    )


def image_depths_at(evidence: Evidence, state: State) -> FloatArray:
    """Depths (m,) that a state has in the place of the evidence's image depths."""
    depths = evidence.image_depths
    points = points_of(evidence.shape, state)[depths.point]
    return seen_in_cameras(evidence, state, points, depths.image)[:, 2]


def _of_gravity(evidence: Evidence, state: State, view: int) -> EvidenceSummary:
    directions = kept_rows(evidence.directions, evidence.directions.image == view)
    origin = seen_in_cameras(evidence, state, 0.0 * directions.model, directions.image)
    seen = seen_in_cameras(evidence, state, directions.model, directions.image)
    differences = seen - origin - directions.camera
    whitened = np.einsum("nij,nj->ni", directions.whitening, differences)
    halves = np.minimum(np.linalg.norm(differences, axis=1) / 2, 1.0)
    angles = np.degrees(2 * np.arcsin(halves))
    return _summary("gravity", view, angles, np.linalg.norm(whitened, axis=1), "deg", 2)


def _of_distances(evidence: Evidence, state: State, piece: Piece) -> EvidenceSummary:
    expected, measured, weights = _distances(evidence, state, piece)
    errors = expected - measured
    return _summary(*piece, errors, errors * weights, "")


def _distances(
    evidence: Evidence, state: State, piece: Piece
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Expected and measured distances of a piece (n,), with the inverse standard deviations."""
    offsets = kept_rows(evidence.offsets, _offsets_of(evidence, piece))
    points, some = points_of(evidence.shape, state), evidence._replace(offsets=offsets)
    return distances_of(some, state.poses, points), offsets.value, offsets.weight


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
    in_sigmas = float(np.sqrt((whitened * whitened).sum() / (equations * count)))
    rms = float(np.sqrt((errors * errors).mean()))
    return EvidenceSummary(kind, view, count, in_sigmas, rms, unit)


# Contributions -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Basis:
    """The evidence in the form of the kernels, and the state that was estimated from it."""

    evidence: Evidence
    state: State
    numbers: tuple[int, ...] | None = None
    """Numbers of its views among all that were given; None where all are used."""
    turn: FloatArray | None = None
    """From the first view's frame to that of the result (3, 3), where it is another."""
    photos: frozenset[int] = frozenset()
    """Views whose contour is that of a photo."""


AnyBasis = Basis | SingleBasis
"""What contributions are computed from."""


def contributions_of(basis: AnyBasis) -> tuple[Contribution, ...]:
    """Standard deviations at the estimate without each piece."""
    found = []
    for piece in pieces_of(basis.evidence):
        rest, state = without(basis.evidence, basis.state, piece)
        view, kind = piece.view, piece.kind
        if kind == "mask" and view in basis.photos:
            kind = "photo"
        if view is not None and basis.numbers is not None:
            view = basis.numbers[view]
        found.append(_contribution(kind, view, rest, state, basis.turn))
    return tuple(found)


def _contribution(
    kind: str, view: int | None, evidence: Evidence, state: State, turn: FloatArray | None
) -> Contribution:
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
    std = uncertainty_of(of_all if turn is None else turned_covariance(of_all, turn))
    distance = float(np.linalg.norm(state.poses[evidence.rig.pose[0], 9:]))
    x, y, z = (_or_infinite(each, _UNKNOWN_SCALE * distance) for each in std.translation)
    sx, sy, sz = (_or_infinite(each, _UNKNOWN_SCALE) for each in std.scale)
    rotation_deg = _or_infinite(std.rotation_deg, _UNKNOWN_ROTATION_DEG)
    focal = _or_infinite(std.focal, _UNKNOWN_SCALE)
    return Contribution(kind, view, Uncertainty(rotation_deg, (x, y, z), (sx, sy, sz), focal))


def _or_infinite(deviation: float, limit: float) -> float:
    return deviation if deviation < limit else float("inf")
