"""Usual mistakes in the keypoints of a plain fit, looked for where they do not fit at all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.mistakes import Explained, Mistake, find_in_all, other_sizes
from cadalign.estimation.uncertainty.misfit import Tested
from cadalign.estimation.uncertainty.posterior import FittedKeypoints
from cadalign.estimation.uncertainty.residuals import chi_square_tail, f_quantile
from cadalign.estimation.uncertainty.summary import Misfit

_CHANCE = 1e-4  # that noise alone leaves residuals in which mistakes are looked for
_CHANCE_OF_RATIO = 1e-3  # that residuals of an unknown noise differ by as much
_LARGE = 0.02  # estimated sigma, over the keypoints' extent, that asks for a mistake
_LEAST_SQUARES = 1e-9  # of exact keypoints


def mistake_in_fit(result: FittedKeypoints, misfit: Misfit | None) -> str | None:
    """Name the mistake in the keypoints of a fit without which they would fit.

    ``misfit`` may tell a camera that they fit as they are. Returns a warning; None where keypoints
    fit, and where no mistake explains the misfit better than that camera. Another image size, which
    leaves nearly as much open as a stretch, counts only where neither a stretch nor a few wrong
    keypoints explain it.
    """
    camera = None if misfit is None else misfit.camera
    has_reason = misfit is not None and bool(misfit.outliers or misfit.free_scale)
    try:
        tested = Tested.of(result)
    except InputError:  # a depth that rounds to zero has no projection
        return None
    redundancy, keypoints = tested.redundancy, len(tested.rows)
    if redundancy < 1:
        return None
    sigma, most = result.sigma if result.options.sigma is None else None, math.inf
    if sigma is None:
        if chi_square_tail(tested.chi_square, redundancy) >= _CHANCE:
            return None
    else:
        if sigma < _LARGE * np.ptp(tested.points_2d, axis=0).max():
            return None
        most = tested.chi_square / f_quantile(redundancy, redundancy, _CHANCE_OF_RATIO)

    def score(fitted: Tested) -> float:
        """Twice the negative log likelihood, at the likeliest sigma where it is not known."""
        if sigma is None:
            return fitted.chi_square
        return 2 * keypoints * math.log(max(fitted.chi_square, _LEAST_SQUARES))

    def explain(mistake: Mistake) -> Explained | None:
        found = _without(tested, mistake)
        if found is None or not found.passes or found.chi_square * mistake.factor**2 > most:
            return None
        corrected[mistake] = math.sqrt(found.chi_square / redundancy)
        return Explained(score(found), keypoints, -float(found.alignment.rotation[1, 1]))

    corrected: dict[Mistake, float] = {}
    sizes: Sequence[Mistake] = () if has_reason else other_sizes(tested.points_2d, tested.camera)
    named = find_in_all(score(tested), keypoints, explain, sizes)
    if named is None:
        return None
    clauses, mistake, best = named
    if camera is not None and score(Tested.of(tested.fit(camera=camera))) < best:
        return None
    given = math.sqrt(tested.chi_square / redundancy)
    what, unit = ("the residuals are", " times what sigma explains")
    if sigma is not None:
        what, unit, given = "sigma is", " px", given * sigma
    after = corrected[mistake] * (sigma or 1.0)
    return f"{clauses}: corrected, {what} {after:.2g}{unit}; as given, {given:.2g}{unit}"


def _without(tested: Tested, mistake: Mistake) -> Tested | None:
    """The fit without a mistake, if there is one."""
    points_3d: FloatArray = mistake.undo_3d(tested.points_3d)
    points_2d = mistake.undo_2d(tested.points_2d, tested.camera)
    try:
        return Tested.of(replace(tested, points_3d=points_3d, points_2d=points_2d).fit())
    except CadalignError:
        return None
