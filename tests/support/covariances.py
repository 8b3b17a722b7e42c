"""Covariances of results, without what is held."""

from __future__ import annotations

import numpy as np

STRETCHED = [0, 1, 2, 3, 4, 5, 7, 8]
"""Unknowns of an alignment whose length along x is known."""


def of_unknowns(covariance: np.ndarray | None) -> np.ndarray:
    """The rows and columns of the unknowns that are not held."""
    assert covariance is not None
    free = np.flatnonzero(covariance.diagonal())
    return covariance[np.ix_(free, free)]
