"""Calibration of a shape model's covariances by models that were held out.

An image determines some directions of shape and pose and leaves others to the prior. Where few
models were learned from, or shapes have heavier tails than Gaussians, errors in the latter are
larger than the prior's covariance says, and no residual shows it. Held-out models tell how much:
each is seen once from a random direction in weak perspective, and pose and shape follow in closed
form, as the equations are linear about the truth.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.special import gammainc

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.shapes.gaussians import Gaussians
from cadalign.shapes.parts import BOX_ROWS

_FACTORS = np.geomspace(1.0, 3.0, 12)  # deviations are never narrowed
_LEAST_KEYPOINTS = 4
_NOMINAL = np.array([0.68, 0.95])
_TOLERANCE = np.array([0.08, 0.05])  # of these shares of truths
_POSE = 6  # a rotation vector, a translation in the image, the logarithm of the scale


class _View(NamedTuple):
    """A model's n keypoints in an image.

    ``entries`` (3 n,) of the shape vector; derivatives of the image ``by_shape`` (2 n, 3 n) and
    ``by_pose`` (2 n, 6), rotation first; the image ``seen`` (2 n,) and the ``truth`` (3 n,).
    """

    entries: IntArray
    by_shape: FloatArray
    by_pose: FloatArray
    seen: FloatArray
    truth: FloatArray


def find_inflation(
    parts: Iterable[tuple[FloatArray, Gaussians]], *, sigma: float, rng: np.random.Generator
) -> float:
    """Find the factor of the shapes' deviations at which held-out truths lie where they should.

    Of the regions of rotation and keypoints the one whose share of truths is furthest from its
    nominal probability decides.

    Parameters
    ----------
    parts : iterable of ((N, m + 2, 3) float, Gaussians)
        Models, NaN for what they lack, and the mixture learned without them.
    sigma : float
        Standard deviation of the image's noise [model units].
    rng : Generator
        Of the directions and the noise.

    Returns
    -------
    float
        1 or more; 1 if no model has enough keypoints.
    """
    turned, moved = [], []
    for rows, mixture in parts:
        for row in rows:
            view = _view(row, sigma, rng)
            if view is not None:
                squares = _squares(view, mixture, sigma)
                turned.append(squares[0])
                moved.append(squares[1])
    if not turned:
        return 1.0
    gaps = np.maximum(_departures(np.array(turned)), _departures(np.concatenate(moved, axis=1).T))
    return float(_FACTORS[np.argmin(gaps)])


def _departures(squares: FloatArray) -> FloatArray:
    """Largest departure of coverage from its nominal value, in tolerances, for every factor (F,).

    ``squares`` (N, F) are those of errors along three coordinates, in stated deviations.
    """
    levels = gammainc(1.5, squares / 2)  # the distribution of chi-square
    shares = np.array([(levels <= nominal).mean(axis=0) for nominal in _NOMINAL])
    gaps = np.abs(shares - _NOMINAL[:, None]) / _TOLERANCE[:, None]
    return np.asarray(gaps.max(axis=0))


def _view(row: FloatArray, sigma: float, rng: np.random.Generator) -> _View | None:
    """A random view of a model, or None if it has too few keypoints."""
    known = np.flatnonzero(np.isfinite(row[:-BOX_ROWS]).all(axis=1))
    quat = rng.standard_normal(4)
    rotation = rotation_from_quat_wxyz(quat / np.linalg.norm(quat))
    noise = rng.standard_normal(2 * (len(row) - BOX_ROWS))[: 2 * len(known)]
    if len(known) < _LEAST_KEYPOINTS:
        return None
    points = row[known]
    turned = (points - points.mean(axis=0)) @ rotation.T
    count = len(known)
    by_pose = np.zeros((count, 2, 6))
    by_pose[:, 0, 1], by_pose[:, 0, 2] = turned[:, 2], -turned[:, 1]
    by_pose[:, 1, 0], by_pose[:, 1, 2] = -turned[:, 2], turned[:, 0]
    by_pose[:, 0, 3] = by_pose[:, 1, 4] = 1.0
    by_pose[:, :, 5] = turned[:, :2]
    by_shape = np.asarray(np.kron(np.eye(count), rotation[:2]), dtype=float)
    truth = np.asarray(points.ravel())
    entries = (3 * known[:, None] + np.arange(3)).ravel()
    return _View(entries, by_shape, by_pose.reshape(-1, 6), by_shape @ truth + sigma * noise, truth)


class _Posterior(NamedTuple):
    """Pose (6,) and shape (3 n,) given an image and one Gaussian, and their covariances."""

    pose: FloatArray
    shape: FloatArray
    of_pose: FloatArray
    of_shape: FloatArray
    log_evidence: float


def _posterior(view: _View, mean: FloatArray, covariance: FloatArray, sigma: float) -> _Posterior:
    """Generalised least squares for the pose, whose prior is flat, then the shape given it."""
    across = view.by_shape @ covariance
    root = np.linalg.cholesky(across @ view.by_shape.T + sigma**2 * np.eye(len(view.seen)))
    gap, by_pose, gain = np.split(
        np.linalg.solve(
            root, np.column_stack([view.seen - view.by_shape @ mean, view.by_pose, across])
        ),
        [1, 1 + _POSE],
        axis=1,
    )
    of_pose = np.linalg.inv(by_pose.T @ by_pose)
    pose = of_pose @ (by_pose.T @ gap)
    rest = gap - by_pose @ pose
    left = gain - by_pose @ (of_pose @ (by_pose.T @ gain))
    return _Posterior(
        pose[:, 0],
        mean + (gain.T @ rest)[:, 0],
        of_pose,
        covariance - gain.T @ left,
        float(
            np.linalg.slogdet(of_pose)[1] / 2
            - np.log(root.diagonal()).sum()
            - (rest * rest).sum() / 2
        ),
    )


def _squares(view: _View, mixture: Gaussians, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Squared errors in deviations of the rotation (F,) and each keypoint (F, n)."""
    means = mixture.means[:, view.entries]
    covariances = mixture.covariances[:, view.entries[:, None], view.entries]
    found = [
        _posterior(view, mean, covariance, sigma)
        for mean, covariance in zip(means, covariances, strict=True)
    ]
    logs = np.log(mixture.weights) + np.array([each.log_evidence for each in found])
    best = int(np.argmax(logs))
    turn, gaps = found[best].pose[:3], (found[best].shape - view.truth).reshape(-1, 3, 1)
    turned, moved = [], []
    for factor in _FACTORS:
        wide = _posterior(view, means[best], factor**2 * covariances[best], sigma)
        turned.append(turn @ np.linalg.solve(wide.of_pose[:3, :3], turn))
        own = np.einsum("iaib->iab", wide.of_shape.reshape(len(gaps), 3, -1, 3))
        moved.append((gaps * np.linalg.solve(own, gaps)).sum(axis=(1, 2)))
    return np.array(turned), np.array(moved)
