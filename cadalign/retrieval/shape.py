"""Distance of two models' shapes by their keypoints, after stretching one to the other."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.retrieval.models import LibraryModel

SAME_SHAPE = 0.01
"""Distance below which two models count as the same shape."""


def shape_distance(est: LibraryModel, gt: LibraryModel) -> float:
    """Root mean square distance of the shared keypoints, as a share of the true ones' extent.

    The estimated model is moved, and stretched along y and z (x is taken as known), to be closest
    to the true one; it is not rotated. NaN with fewer than 2 shared keypoints.

    Examples
    --------
    >>> xyz = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    >>> bounds = np.array([[0, 0, 0], [1, 1, 1.0]])
    >>> one = LibraryModel("box", "1", xyz, np.arange(4), bounds)
    >>> two = LibraryModel("box", "2", xyz * [1, 2, 0.5] + 0.1, np.arange(4), bounds)
    >>> round(shape_distance(two, one), 12)
    0.0
    """
    if est.category != gt.category:
        raise InputError(f"the categories {est.category!r} and {gt.category!r} differ", where="est")
    _, mine, theirs = np.intersect1d(est.ids, gt.ids, return_indices=True)
    return float(distances(est.xyz[None, mine], gt.xyz[theirs])[0])


def distances(est: FloatArray, gt: FloatArray) -> FloatArray:
    """Compute the shape distance of models' keypoints (m, k, 3) from others (k, 3), (m,) float."""
    if len(gt) < 2:
        return np.full(len(est), np.nan)
    moved = est - est.mean(axis=1, keepdims=True)
    wanted = gt - gt.mean(axis=0)
    squares = (moved**2).sum(axis=1)
    products = (moved * wanted).sum(axis=1)
    # A mirrored or flat model cannot be stretched to the other.
    scale = np.maximum(products, 0.0) / np.where(squares > 0, squares, 1.0)
    scale[:, 0] = 1.0
    gaps = moved * scale[:, None] - wanted
    extent = float(np.linalg.norm(np.ptp(gt, axis=0))) or np.nan
    return np.asarray(np.sqrt((gaps**2).sum(axis=2).mean(axis=1)) / extent)
