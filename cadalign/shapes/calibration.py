"""Calibration of a shape model's covariances and tails by held-out models.

An image determines some directions of shape and pose; the prior determines the others. If there are
few training models, or shapes have heavier tails than Gaussians, errors in the latter directions
exceed the prior's covariance, and no residual shows it. Held-out models measure the excess: each is
projected from a random direction in weak perspective, once with all of its keypoints and once with
a few. The equations are linearised about the truth, so pose and shape follow in closed form. The
calibration finds a factor of the standard deviations for both numbers of keypoints, and the degrees
of freedom of the errors' t distribution.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.alignment import are_on_a_line
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.shapes.gaussians import Gaussians, Vectors
from cadalign.shapes.parts import (
    BOX_ROWS,
    FEW,
    OUTWARD,
    BoxMargins,
    FewKeypoints,
    probability_within,
)

_FACTORS = np.geomspace(1.0, 3.0, 12)  # at least 1: sigmas are never reduced
_DEGREES_OF_FREEDOM = (None, 20.0, 10.0, 7.0, 5.0, 4.0, 3.0)
_LEAST_KEYPOINTS = 4
_ON_A_LINE = 1e-6  # ratio of extents below which the rotation about the line is undetermined
_NOMINAL = np.array([0.68, 0.95])
_TOLERANCE = np.array([0.08, 0.05])  # of the coverage at these probabilities
_EXCEEDED = 95.0  # percentile of the linear box's errors
_POSE = 6  # unknowns: rotation vector, translation in the image, logarithm of the scale


class ShapeCalibration(NamedTuple):
    """Factor of the standard deviations, and degrees of freedom of the errors, None if Gaussian."""

    inflation: float = 1.0
    degrees_of_freedom: float | None = None
    few_keypoints: FewKeypoints | None = None


class _View(NamedTuple):
    """An image of g of a model's n keypoints.

    ``entries`` (3 n,) index the shape vector. ``shape_derivatives`` (2 g, 3 n) and
    ``pose_derivatives`` (2 g, 6) are those of the image, ``image`` (2 g,) the observed and
    ``truth`` (n, 3) the true points.
    """

    entries: IntArray
    shape_derivatives: FloatArray
    pose_derivatives: FloatArray
    image: FloatArray
    truth: FloatArray


def calibrate(
    parts: Iterable[tuple[FloatArray, Gaussians]], *, sigma: float, rng: np.random.Generator
) -> ShapeCalibration:
    """Find the factor and the degrees of freedom with the best coverage of held-out truths.

    The coverage of the regions of rotations and keypoints is compared with nominal probabilities,
    by least squares. ``parts`` are held-out models (N, m + 2, 3), NaN if missing, each with the
    mixture learned without them. ``sigma`` is the standard deviation of the image's noise [model
    units]. ``rng`` draws directions, given keypoints and noise. The factor is at least 1. Without
    a model of enough keypoints it is 1, and errors are Gaussian.
    """
    every: list[tuple[FloatArray, FloatArray]] = []
    few: list[tuple[FloatArray, FloatArray]] = []
    counts = []
    for rows, mixture in parts:
        for row in rows:
            known = np.flatnonzero(np.isfinite(row[:-BOX_ROWS]).all(axis=1))
            count = len(known)
            if count >= _LEAST_KEYPOINTS and not are_on_a_line(row[known], _ON_A_LINE):
                counts.append(count)
                view = _view(known, np.arange(count), row, sigma, rng)
                every.append(_squared_errors(view, mixture, sigma))
            given = rng.permutation(count)[:FEW] if count > FEW else None
            if given is not None and not are_on_a_line(row[known[given]], _ON_A_LINE):
                view = _view(known, given, row, sigma, rng)
                few.append(_squared_errors(view, mixture, sigma))
    if not counts:
        return ShapeCalibration()
    gaps, typical = _coverage_errors(every)[:, :, None], float(np.mean(counts))
    if few and typical > FEW:
        is_less = np.tri(len(_FACTORS), dtype=bool)  # or equal
        gaps = np.where(is_less, gaps + _coverage_errors(few)[:, None], np.inf)
    freedom, row, lower = np.unravel_index(np.argmin(gaps), gaps.shape)
    factor, of_few = float(_FACTORS[row]), None
    if gaps.shape[2] > 1:
        of_few = FewKeypoints(typical, float(_FACTORS[lower]) / factor)
    return ShapeCalibration(factor, _DEGREES_OF_FREEDOM[freedom], of_few)


def _coverage_errors(squares: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Squared differences of coverage from nominal, by degrees of freedom and factor."""
    turned = np.array([each for each, _ in squares])
    moved = np.concatenate([each for _, each in squares], axis=1).T
    found = np.zeros((len(_DEGREES_OF_FREEDOM), len(_FACTORS)))
    for row, freedom in enumerate(_DEGREES_OF_FREEDOM):
        for errors in (turned, moved):
            levels = probability_within(errors, 3, freedom)
            shares = np.array([(levels <= nominal).mean(axis=0) for nominal in _NOMINAL])
            found[row] += (((shares.T - _NOMINAL) / _TOLERANCE) ** 2).sum(axis=1)
    return found


def _view(
    known: IntArray, given: IntArray, row: FloatArray, sigma: float, rng: np.random.Generator
) -> _View:
    """Draw a view of a model's known keypoints (n,), of which (g,) are given."""
    quat = rng.standard_normal(4)
    rotation = rotation_from_quat_wxyz(quat / np.linalg.norm(quat))
    points = row[known]
    turned = (points[given] - points[given].mean(axis=0)) @ rotation.T
    pose_derivatives = np.zeros((len(given), 2, _POSE))
    pose_derivatives[:, 0, 1], pose_derivatives[:, 0, 2] = turned[:, 2], -turned[:, 1]
    pose_derivatives[:, 1, 0], pose_derivatives[:, 1, 2] = -turned[:, 2], turned[:, 0]
    pose_derivatives[:, 0, 3] = pose_derivatives[:, 1, 4] = 1.0
    pose_derivatives[:, :, 5] = turned[:, :2]
    shape_derivatives = np.asarray(np.kron(np.eye(len(known))[given], rotation[:2]), dtype=float)
    entries = (3 * known[:, None] + np.arange(3)).ravel()
    image = shape_derivatives @ points.ravel() + sigma * rng.standard_normal(len(shape_derivatives))
    return _View(entries, shape_derivatives, pose_derivatives.reshape(-1, _POSE), image, points)


class _Posterior(NamedTuple):
    """Pose (6,) and keypoints (n, 3) given an image and one Gaussian.

    Covariances of the rotation (F, 3, 3) and of each keypoint (F, n, 3, 3) are for each of F
    factors of the prior's standard deviations.
    """

    pose: FloatArray
    points: FloatArray
    rotation_covariance: FloatArray
    point_covariances: FloatArray
    log_evidence: float


def _posterior(view: _View, mean: FloatArray, covariance: FloatArray, sigma: float) -> _Posterior:
    """Estimate the pose, with a flat prior, by generalised least squares, then the shape.

    In the eigenbasis of the shape's covariance in the image, covariances are diagonal.
    """
    n, squares = len(mean) // 3, _FACTORS**2
    across = view.shape_derivatives @ covariance
    values, vectors = np.linalg.eigh(across @ view.shape_derivatives.T)
    precisions = 1 / (squares[:, None] * np.maximum(values, 0.0) + sigma**2)  # (F, 2 g)
    known = np.column_stack([view.image - view.shape_derivatives @ mean, view.pose_derivatives])
    known, across = vectors.T @ known, vectors.T @ across
    gap, pose_derivatives = known[:, 0], known[:, 1:]
    weighted = pose_derivatives.T * precisions[:, None]  # (F, 6, 2 g)
    of_pose = np.linalg.inv(weighted @ pose_derivatives)
    gain = weighted @ across  # (F, 6, 3 n)
    blocks = across.reshape(-1, n, 3)
    pairs = (blocks[..., :, None] * blocks[..., None, :]).reshape(len(across), -1)
    reduction = (precisions @ pairs).reshape(-1, n, 3, 3)
    by_point = (-1, _POSE, n, 3)
    left = (of_pose @ gain).reshape(by_point).transpose(0, 2, 3, 1)
    reduction -= left @ gain.reshape(by_point).transpose(0, 2, 1, 3)
    own = np.einsum("iaib->iab", covariance.reshape(n, 3, n, 3))
    first = precisions[0]  # estimates do not use the factor
    pose = of_pose[0] @ (weighted[0] @ gap)
    gap = gap - pose_derivatives @ pose
    rest = first * gap
    each = squares[:, None, None, None]
    return _Posterior(
        pose,
        (mean + rest @ across).reshape(-1, 3),
        of_pose[:, :3, :3],
        each * own - each**2 * reduction,
        float(np.linalg.slogdet(of_pose[0])[1] / 2 + np.log(first).sum() / 2 - rest @ gap / 2),
    )


def _squared_errors(view: _View, mixture: Gaussians, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Squared errors, in standard deviations, of the rotation (F,) and each keypoint (F, n).

    As in `cadalign.align`, covariances are the second moments of the mixture about the likeliest
    component's estimate.
    """
    means = mixture.means[:, view.entries]
    covariances = mixture.covariances[:, view.entries[:, None], view.entries]
    found = [
        _posterior(view, mean, covariance, sigma)
        for mean, covariance in zip(means, covariances, strict=True)
    ]
    logs = np.log(mixture.weights) + np.array([each.log_evidence for each in found])
    shares = np.exp(logs - np.logaddexp.reduce(logs))
    best = found[int(np.argmax(shares))]
    rotation = np.zeros_like(best.rotation_covariance)
    points = np.zeros_like(best.point_covariances)
    for share, each in zip(shares, found, strict=True):
        turn, steps = (each.pose - best.pose)[:3], each.points - best.points
        rotation += share * (each.rotation_covariance + np.outer(turn, turn))
        points += share * (each.point_covariances + steps[:, :, None] * steps[:, None])
    turn, gaps = best.pose[:3, None], (best.points - view.truth)[:, :, None]
    turned = turn * np.linalg.solve(rotation, np.broadcast_to(turn, (len(rotation), 3, 1)))
    solved = np.linalg.solve(points, np.broadcast_to(gaps, (*points.shape[:-1], 1)))
    return turned.sum(axis=(1, 2)), (gaps * solved).sum(axis=(2, 3))


def box_excesses(rows: FloatArray, mixture: Gaussians) -> FloatArray:
    """Distances of linear boxes beyond the true faces of held-out models, (N, 2, 3)."""
    without = rows.copy()
    without[:, -BOX_ROWS:] = np.nan
    vectors = Vectors(without.reshape(len(rows), -1), np.ones(len(rows)))
    linear = vectors.complete(mixture).reshape(rows.shape)
    return np.asarray(OUTWARD * (linear - rows)[:, -BOX_ROWS:])


def learn_margins(rows: FloatArray, excesses: FloatArray) -> BoxMargins | None:
    """Learn margins from models and `box_excesses`; None if no model has a box."""
    has_box = np.isfinite(rows[:, -BOX_ROWS:]).all(axis=(1, 2))
    if not has_box.any():
        return None
    points, boxes = rows[has_box, :-BOX_ROWS], rows[has_box, -BOX_ROWS:]
    reached = np.stack([np.nanmin(points, axis=1), np.nanmax(points, axis=1)], axis=1)
    return BoxMargins(
        np.median(OUTWARD * (boxes - reached), axis=0),
        np.maximum(np.percentile(excesses[has_box], _EXCEEDED, axis=0), 0.0),
    )
