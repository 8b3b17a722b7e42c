"""Products of stacked vectors, each rounded as that of a single pair."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray


def dots(first: FloatArray, second: FloatArray) -> FloatArray:
    """Dot products (...) of vectors (..., k), those of BLAS bit for bit.

    Examples
    --------
    >>> dots(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[1.0, 1.0], [0.0, 2.0]])).tolist()
    [3.0, 8.0]
    """
    return np.asarray(np.matmul(first[..., None, :], second[..., :, None])[..., 0, 0])


def lengths(vectors: FloatArray) -> FloatArray:
    """Euclidean lengths (...) of vectors (..., k), those of `numpy.linalg.norm` bit for bit."""
    return np.sqrt(dots(vectors, vectors))
