"""Starts of an estimate that determines the object's size: linear in all but the rotation.

For a camera (C, c) of a rig, a point of the model is seen at ``X = C (R diag(s) x + t) + c``. Its
ray says ``X_x = u X_z`` and ``X_y = v X_z``, its depth ``X_z = z``, and known lengths and heights
of cameras are linear too: all of them hold for ``R diag(s)`` and t, 12 unknowns, and for s and t
where R is given. None is homogeneous, so that views with one keypoint count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.prior import has_scale_prior
from cadalign.solvers.joint.evidence import Evidence

_GRID = 400
_SCREENED = 64
_MOST_STARTS = 16
_ROUNDS = 3  # of weighting by the depths of the last
_ROUNDS_GIVEN_ROTATION = 2
_LEAST_EQUATIONS = 12
_CONDITION = 1e-7  # least singular value over the largest, of columns of unit length
_LEAST_SCALE = 1e-6


class _Rows(NamedTuple):
    """Equations in points of the rig: ``normals`` (N, 3), ``right`` (N,), inverse deviations.

    They are of the model's ``points`` (N, 3), seen from a camera with ``turns`` and ``shifts``;
    ``is_ray`` (N,) is 1 where the deviation is that of a ray: it grows with the depth.
    """

    points: FloatArray
    turns: FloatArray
    shifts: FloatArray
    normals: FloatArray
    right: FloatArray
    weights: FloatArray
    is_ray: FloatArray

    def depths(self, matrix: FloatArray, translation: FloatArray) -> FloatArray:
        """Depths (N,) in the cameras of points at a pose."""
        in_rig = self.points @ matrix.T + translation
        return np.asarray((np.einsum("nij,nj->ni", self.turns, in_rig) + self.shifts)[:, 2])

    def weights_at(self, depths: FloatArray) -> FloatArray:
        """Weights (N,) of the equations at depths."""
        return np.asarray(self.weights / np.where(self.is_ray > 0, np.maximum(depths, 1e-3), 1.0))


def metric_starts(evidence: Evidence, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses (S, 1, 12) and log scales (S, 3) of evidence with one pose, the likeliest first.

    ``rotations`` (S, 3, 3) are proposals in the rig's frame; that of the linear solution and, where
    the proposals are few, those of a grid join them.
    """
    rows = _rows_of(evidence)
    linear = _linear_rotation(rows)
    proposed = [rotations.reshape(-1, 3, 3)]
    if linear is not None:
        proposed.insert(0, linear[None])
    if not len(rotations):
        proposed.append(_screened(evidence, rows, _rotation_grid()))
    candidates = np.concatenate(proposed)
    systems = [_given_rotation(evidence, rows, rotation) for rotation in candidates]
    found = [each for each in systems if each is not None]
    found.sort(key=lambda placed: placed.cost)
    best = found[:_MOST_STARTS]
    poses = [np.concatenate([each.rotation.ravel(), each.translation]) for each in best]
    logs = [each.log_scales for each in best]
    return np.array(poses).reshape(-1, 1, 12), np.array(logs).reshape(-1, 3)


def _rows_of(evidence: Evidence) -> _Rows:
    sightings, planes, shape = evidence.sightings, evidence.planes, evidence.shape
    u, v = sightings.rays.T
    zeros, ones = np.zeros_like(u), np.ones_like(u)
    a, b, c = sightings.whitening.T
    normals = [
        np.stack([a, b, -(a * u + b * v)], axis=1),
        np.stack([zeros, c, -c * v], axis=1),
        np.stack([zeros, zeros, ones], axis=1),
        planes.normal,
    ]
    right = [zeros, zeros, sightings.depths[:, 0], planes.depth]
    weights = [(c > 0).astype(float), (c > 0).astype(float), sightings.depths[:, 1], planes.weight]
    point = np.concatenate([np.tile(sightings.point, 3), planes.point])
    image = np.concatenate([np.tile(sightings.image, 3), planes.image])
    is_ray = np.concatenate([np.ones(2 * len(u)), np.zeros(len(u) + len(planes.point))])
    weight, normal = np.concatenate(weights), np.concatenate(normals)
    kept = weight > 0
    cameras, normal = evidence.rig.cam_from_rig[image[kept]], normal[kept]
    turns, shifts = cameras[:, :9].reshape(-1, 3, 3), cameras[:, 9:]
    return _Rows(
        shape.mean[point[kept]],
        turns,
        shifts,
        np.einsum("ni,nij->nj", normal, turns),
        np.concatenate(right)[kept] - (normal * shifts).sum(axis=1),
        weight[kept],
        is_ray[kept],
    )


def _linear_rotation(rows: _Rows) -> FloatArray | None:
    """The rotation nearest to the linear solution; None where it is not determined."""
    if len(rows.right) < _LEAST_EQUATIONS:
        return None
    by_matrix = (rows.normals[:, :, None] * rows.points[:, None]).reshape(-1, 9)
    left, weights = np.concatenate([by_matrix, rows.normals], axis=1), rows.weights
    found = np.zeros(12)
    for _ in range(_ROUNDS):
        weighted = left * weights[:, None]
        sizes = np.linalg.norm(weighted, axis=0)
        if not (sizes > 0).all():
            return None
        solved, _, _, singular = np.linalg.lstsq(weighted / sizes, rows.right * weights, rcond=None)
        if singular[-1] < _CONDITION * singular[0]:
            return None
        found = solved / sizes
        weights = rows.weights_at(rows.depths(found[:9].reshape(3, 3), found[9:]))
    matrix = found[:9].reshape(3, 3)
    lengths = np.linalg.norm(matrix, axis=0)
    if np.linalg.det(matrix) <= 0 or not (lengths > 0).all():
        return None
    rotation = np.eye(3)
    for _ in range(_ROUNDS):  # nearest rotation and column lengths in turn
        left_vectors, _, right_vectors = np.linalg.svd(matrix * lengths)
        rotation = left_vectors @ right_vectors
        lengths = np.maximum((rotation * matrix).sum(axis=0), 1e-3 * lengths.max())
    return np.asarray(rotation) if np.linalg.det(rotation) > 0 else None


class _Placed(NamedTuple):
    rotation: FloatArray
    translation: FloatArray
    log_scales: FloatArray
    cost: float


def _given_rotation(evidence: Evidence, rows: _Rows, rotation: FloatArray) -> _Placed | None:
    """Translation and scales from the equations that are linear once the rotation is given."""
    basis = _scale_basis(evidence)
    by_scale = (rows.normals @ rotation) * rows.points
    left = np.concatenate([rows.normals, by_scale @ basis], axis=1)
    extra_left, extra_right = _other_rows(evidence, rotation, basis)
    weights, cost = rows.weights, np.inf
    found = np.zeros(left.shape[1])
    for _ in range(_ROUNDS_GIVEN_ROTATION):
        weighted = np.concatenate([left * weights[:, None], extra_left])
        target = np.concatenate([rows.right * weights, extra_right])
        sizes = np.linalg.norm(weighted, axis=0)
        if not (sizes > 0).all():
            return None
        normal = (weighted / sizes).T @ (weighted / sizes)
        try:
            found = np.linalg.solve(normal, (weighted / sizes).T @ target) / sizes
        except np.linalg.LinAlgError:
            return None
        error = weighted @ found - target
        cost = float(error @ error)
        scales = basis @ found[3:]
        depths = rows.depths(rotation * scales, found[:3])
        weights = rows.weights_at(depths)
    if not (scales > _LEAST_SCALE).all() or not (depths > 0).all() or not np.isfinite(cost):
        return None
    return _Placed(rotation, found[:3], np.log(scales), cost + _cost_of_up(evidence, rotation))


def _screened(evidence: Evidence, rows: _Rows, rotations: FloatArray) -> FloatArray:
    """The rotations (S, 3, 3) with the least algebraic error, unweighted by depth."""
    basis = _scale_basis(evidence)
    by_scale = (rows.normals @ rotations) * rows.points
    same = np.broadcast_to(rows.normals, by_scale.shape)
    left = np.concatenate([same, by_scale @ basis], axis=2) * rows.weights[:, None]
    right = rows.right * rows.weights
    normal = left.swapaxes(1, 2) @ left
    ridge = _CONDITION**2 * np.trace(normal, axis1=1, axis2=2)[:, None, None]
    normal = normal + ridge * np.eye(left.shape[2])
    projected = (left.swapaxes(1, 2) @ right)[:, :, None]
    try:
        found = np.linalg.solve(normal, projected)
    except np.linalg.LinAlgError:  # of one rotation, where the ridge is lost in rounding
        found = np.linalg.pinv(normal, hermitian=True) @ projected
    errors = (((left @ found)[:, :, 0] - right) ** 2).sum(axis=1)
    costs = errors + [_cost_of_up(evidence, rotation) for rotation in rotations]
    return np.asarray(rotations[np.argsort(costs)[:_SCREENED]])


def _scale_basis(evidence: Evidence) -> FloatArray:
    """Scales (3, k) as sums of unknowns: three, or a common one where a prior holds them so."""
    return np.ones((3, 1)) if has_scale_prior(evidence.scales) else np.eye(3)


def _other_rows(
    evidence: Evidence, rotation: FloatArray, basis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened equations of known distances, in translation and scales."""
    offsets, mean = evidence.offsets, evidence.shape.mean
    rows, right = [np.empty((0, 3 + basis.shape[1]))], [np.empty(0)]
    for (*ends, image), direction, value, weight in zip(
        np.column_stack([offsets.ends, offsets.image]).tolist(),
        offsets.direction,
        offsets.value,
        offsets.weight,
        strict=True,
    ):
        row, known = np.zeros(6), value
        for point, sign in zip(ends, (-1.0, 1.0), strict=True):
            if point >= 0:
                row[3:] += sign * direction * mean[point]
            else:
                camera, turned = evidence.rig.cam_from_rig[image], rotation @ direction
                row[:3] -= sign * turned
                known += sign * turned @ (camera[:9].reshape(3, 3).T @ camera[9:])
        rows.append(weight * np.concatenate([row[:3], row[3:] @ basis])[None])
        right.append(np.array([weight * known]))
    return np.concatenate(rows), np.concatenate(right)


def _cost_of_up(evidence: Evidence, rotation: FloatArray) -> float:
    """Squared whitened differences of known directions."""
    directions = evidence.directions
    turns = evidence.rig.cam_from_rig[directions.image][:, :9].reshape(-1, 3, 3)
    seen = np.einsum("dij,dj->di", turns, directions.model @ rotation.T) - directions.camera
    whitened = np.einsum("dij,dj->di", directions.whitening, seen)
    return float((whitened * whitened).sum())


def _rotation_grid() -> FloatArray:
    """Rotations (S, 3, 3) spread evenly.

    Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
    """
    from scipy.spatial.transform import Rotation

    psi = 1.533751168755204288118041
    place = np.arange(_GRID) + 0.5
    r, q = np.sqrt(place / _GRID), np.sqrt(1 - place / _GRID)
    alpha, beta = 2 * np.pi * place / np.sqrt(2), 2 * np.pi * place / psi
    quats = np.stack([r * np.sin(alpha), r * np.cos(alpha), q * np.sin(beta), q * np.cos(beta)], 1)
    return np.asarray(Rotation.from_quat(quats).as_matrix())
