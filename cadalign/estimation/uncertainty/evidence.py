"""Pieces of evidence: the rows of each, and how well it agrees with an estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.prior import has_scale_prior
from cadalign.estimation.result_parts import EvidenceSummary
from cadalign.geometry.camera import Camera
from cadalign.solvers.joint.evidence import (
    Evidence,
    Sightings,
    State,
    depths_along_axes,
    distances_of,
    kept_rows,
    log_focals_of,
    points_of,
    seen_in_cameras,
)

_OUTLIER = 8.0  # [sigma], of a depth: it is that of something else


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
    told["gravity"] = evidence.directions.image
    told["camera height"] = offsets.image[offsets.image >= 0]
    told["rig"] = np.flatnonzero(rig.is_shared)
    views = {kind: set(rows.tolist()) for kind, rows in told.items()}
    pieces = [
        Piece(kind, view) for view in range(len(rig.pose)) for kind in views if view in views[kind]
    ]
    if (offsets.image < 0).any():
        pieces.append(Piece("size", None))
    return pieces


def image_of(piece: Piece) -> int:
    """The number that a piece's rows have as their image; -1 for the object's size."""
    return -1 if piece.view is None else piece.view


def count_equations(evidence: Evidence) -> int:
    """Number of equations, those of priors included; what is exact adds none."""
    told = {kind: int(rows.sum()) for kind, rows in told_by(evidence.sightings).items()}
    count = 2 * told["keypoints"] + told["mask"] + told["depth"]
    count += 2 * len(evidence.directions.image) + len(evidence.offsets.weight)
    count += len(evidence.shape.modes)
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
            expected, measured, weights = depths_of(evidence, state, piece.view)
            errors = expected - measured
            counted = np.abs(errors * weights) < _OUTLIER
            if not counted.any():
                counted[:] = True
            found.append(_summary(*piece, errors[counted], (errors * weights)[counted], ""))
    return tuple(found)


def _sighted(evidence: Evidence, state: State, rows: BoolArray) -> FloatArray:
    """Points (n, 3) of some sightings in their cameras."""
    points = points_of(evidence.shape, state)[evidence.sightings.point[rows]]
    return seen_in_cameras(evidence, state.poses, points, evidence.sightings.image[rows])


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


def depths_of(
    evidence: Evidence, state: State, view: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Expected and measured depths of a view (n,), with the inverse standard deviations."""
    sightings = evidence.sightings
    rows = told_by(sightings)["depth"] & (sightings.image == view)
    points = points_of(evidence.shape, state)[sightings.point[rows]]
    expected = depths_along_axes(evidence, state.poses, points, sightings.image[rows])
    return expected, sightings.depths[rows, 0], sightings.depths[rows, 1]


def _of_gravity(evidence: Evidence, state: State, view: int) -> EvidenceSummary:
    directions = kept_rows(evidence.directions, evidence.directions.image == view)
    origin = seen_in_cameras(evidence, state.poses, 0.0 * directions.model, directions.image)
    seen = seen_in_cameras(evidence, state.poses, directions.model, directions.image)
    differences = seen - origin - directions.camera
    whitened = np.einsum("nij,nj->ni", directions.whitening, differences)
    halves = np.minimum(np.linalg.norm(differences, axis=1) / 2, 1.0)
    angles = np.degrees(2 * np.arcsin(halves))
    return _summary("gravity", view, angles, np.linalg.norm(whitened, axis=1), "deg", 2)


def _of_distances(evidence: Evidence, state: State, piece: Piece) -> EvidenceSummary:
    expected, measured, weights = distances_beside(evidence, state, piece)
    errors = expected - measured
    return _summary(*piece, errors, errors * weights, "")


def distances_beside(
    evidence: Evidence, state: State, piece: Piece
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Expected and measured distances of a piece (n,), with the inverse standard deviations."""
    offsets = kept_rows(evidence.offsets, evidence.offsets.image == image_of(piece))
    points, some = points_of(evidence.shape, state), evidence.with_block(offsets)
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
