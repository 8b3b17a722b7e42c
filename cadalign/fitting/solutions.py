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

    ``poses`` (B, k, 15) are packed, ``costs`` (B, k) their whitened squared errors, infinite where
    there is none; ``covariances`` (B, 8, 8) or (B, 9, 9) and ``residuals`` (n, 2) [px] are those of
    the best. ``info`` (B, 4) counts minima, iterations and hypotheses, and names an undetermined
    unknown or -1. ``focals`` (B, k) and ``sigmas`` (B,) [px] are there where they were estimated.
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
