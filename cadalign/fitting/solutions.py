"""Solutions of a batch of problems: the one form that every solver's answer takes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import CadalignError

_NO_RESIDUALS = np.empty((0, 2))
_NO_ERRORS: Mapping[int, CadalignError] = MappingProxyType({})


class Solutions(NamedTuple):
    """Minima of every problem, the best first.

    Parameters
    ----------
    poses : (B, k, 15) float
        Packed alignments, see `cadalign.solvers.unknowns`.
    costs : (B, k) float
        Their whitened squared errors; infinite where there is none.
    covariances : (B, 8, 8) or (B, 9, 9) float or None
        Of the best: rotation vector, translation, log scales, log focal length.
    statuses : (B,) int
        See `cadalign.solvers.constants`.
    info : (B, 4) int
        Minima, iterations, hypotheses, undetermined unknown or -1.
    focals : (B, k) float, optional
        Focal lengths of the poses [px], where they were estimated.
    sigmas : (B,) float, optional
        Estimated standard deviations of the keypoints [px].
    residuals : (n, 2) float
        Projected minus observed keypoints of the best [px].
    errors : mapping of int to CadalignError
        Reasons why problems have no solution, by problem.
    """

    poses: FloatArray
    costs: FloatArray
    covariances: FloatArray | None
    statuses: IntArray
    info: IntArray
    focals: FloatArray | None = None
    sigmas: FloatArray | None = None
    residuals: FloatArray = _NO_RESIDUALS
    errors: Mapping[int, CadalignError] = _NO_ERRORS
