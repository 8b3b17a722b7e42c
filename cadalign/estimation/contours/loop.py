"""Fit the model's rim to masks' contours, together with all other evidence.

Rounds of steps approach the contours and learn from the residuals how accurate these are; then the
cost at that noise is lowered until no step does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.descent import (
    Descent,
    Masked,
    Place,
    PlacedRims,
    Stacked,
    rims_at,
    stack,
    step_of,
)
from cadalign.estimation.contours.noise import (
    OWN_MODES,
    Noise,
    first_noise,
    noise_of,
    noise_of_similar,
    with_learned_offsets,
)
from cadalign.estimation.contours.rims import Rims
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.reduction import reduced
from cadalign.solvers.joint.search import score_state

_FIRST_REACH = 24.0  # [px], and the same relative to the contour's size
_RELATIVE_REACH = 0.04
_WIDE_REACH = 0.15  # where nothing but the masks determines the estimate
_LEAST_REACH = 4.0
_REACH = 6.0  # in deviations of the residuals
_MOST_ROUNDS = 16
_FEW_ITERATIONS = 4  # of a round, whose rims are not those of its end
_SETTLED = 0.02  # [px], median change of the offsets from round to round, or in deviations
_MOST_NOISES = 3  # that are learned, each where the cost at the last is least


class ContourFit(NamedTuple):
    """A view's contour at an estimate: rims, residuals (S,) [px] with the offset removed, noise."""

    rims: Rims
    residuals: FloatArray
    noise: Noise
    offset: float


class Settled(NamedTuple):
    """An estimate; its ``evidence`` and ``state`` hold the rims, ``place`` does not."""

    evidence: Evidence
    state: State
    place: Place
    fits: tuple[ContourFit, ...]
    cost: float
    score: float
    rounds: int

    @property
    def noises(self) -> list[Noise]:
        """The noise of every contour."""
        return [fit.noise for fit in self.fits]


def start_at(state: State, views: int) -> Place:
    """The place of a state, where the contours' own modes are zero."""
    return Place(state, np.zeros((views, OWN_MODES)))


def settle(masked: Masked, state: State, *, is_wide: bool = False) -> Settled | None:
    """Descend from one start; None where no rim comes near a contour.

    ``is_wide`` says that the start may be far off.
    """
    first_reach = _first_reach(masked, _WIDE_REACH if is_wide else _RELATIVE_REACH)
    approached = _approach(masked, start_at(state, len(masked.views)), first_reach)
    if approached is None:
        return None
    place, noises, reach, rounds = approached
    is_exact, here = masked.surface.is_exact, None
    for _ in range(_MOST_NOISES):
        look = rims_at(masked, place, reach, is_fine=is_exact) if here is None else here.look
        learned = _learned(masked, place, look, noises, reach, correlated=True)
        if here is not None and is_exact:
            learned, own = with_learned_offsets(here.evidence, here.state, learned, place.own)
            place = place._replace(own=own)
        if here is not None and (not is_exact or all(map(Noise.is_like, noises, learned))):
            break  # a similar surface's noise is learned on the way
        noises = learned
        here = stack(masked, place, look, noises, reach)
        if here is None:
            return None
        here, steps = Descent(masked, noises, reach).run(here)
        place, rounds = here.place, rounds + steps
    return None if here is None else _settled(here, noises, rounds)


def settle_with(
    masked: Masked, place: Place, noises: list[Noise], others: Sequence[Place] = ()
) -> Settled | None:
    """Descend at a known noise, so that the scores of several estimates compare.

    ``others`` are estimates from other starts, towards which the cost is tried, too.
    """
    reach = min(_first_reach(masked, _RELATIVE_REACH), _reach_of(noises))
    descent = Descent(masked, noises, reach, others)
    here = descent.at(place)
    if here is None:
        return None
    here, steps = descent.run(here)
    return _settled(here, noises, steps)


def _first_reach(masked: Masked, share: float) -> float:
    return max(_FIRST_REACH, *(share * view.contour.size for view in masked.views))


def _reach_of(noises: list[Noise]) -> float:
    return max(_REACH * max(noise.sigma for noise in noises), _LEAST_REACH)


def _approach(
    masked: Masked, place: Place, reach: float
) -> tuple[Place, list[Noise], float, int] | None:
    """Steps that learn the noise from the residuals, until the rims change little."""
    is_exact = masked.surface.is_exact
    noises = [first_noise(view.sigma, reach, is_exact=is_exact) for view in masked.views]
    last: list[Rims] = []
    rounds = 0
    while rounds < _MOST_ROUNDS:
        look = rims_at(masked, place, reach, is_fine=False)
        widest = max(noise.sigma for noise in noises)
        if _change(last, look.rims) < _SETTLED * max(1.0, widest):
            break
        noises = _learned(masked, place, look, noises, reach, correlated=False)
        if is_exact:
            reach = min(reach, _reach_of(noises))
        here = stack(masked, place, look, noises, reach)
        step = None if here is None else step_of(masked, here, _FEW_ITERATIONS)
        if here is None or step is None:
            return None
        place, last, rounds = step, look.rims, rounds + 1
        if is_exact:
            noises, own = with_learned_offsets(here.evidence, here.at(step), noises, step.own)
            place = step._replace(own=own)
    return place, noises, reach, rounds


def _change(last: list[Rims], rims: list[Rims]) -> float:
    """Median change of the rims' offsets [px] since the last round; infinite in the first."""
    if not last:
        return np.inf
    changes = [np.zeros(0)]
    for before, after in zip(last, rims, strict=True):
        both = before.found & after.found
        changes.append(np.abs(after.offset - before.offset)[both])
    every = np.concatenate(changes)
    return float(np.median(every)) if len(every) else np.inf


def _learned(
    masked: Masked,
    place: Place,
    look: PlacedRims,
    noises: list[Noise],
    reach: float,
    *,
    correlated: bool,
) -> list[Noise]:
    """The noise that the residuals at a place show."""
    found = []
    for view, rims, bias, noise, own in zip(
        masked.views, look.rims, look.biases, noises, place.own, strict=True
    ):
        residuals = np.where(rims.found, rims.offset + own[0] * noise.offset, np.nan)
        given = view.contour, view.sigma, rims
        if masked.surface.is_exact:
            found.append(noise_of(*given, residuals - bias, noise, correlated=correlated))
        else:
            found.append(noise_of_similar(*given, residuals, reach))
    return found


def _settled(here: Stacked, noises: list[Noise], rounds: int) -> Settled:
    offsets = [own[0] * noise.offset for own, noise in zip(here.place.own, noises, strict=True)]
    fits = tuple(
        ContourFit(rims, np.where(rims.found, rims.offset + offset, np.nan), noise, offset)
        for rims, noise, offset in zip(here.look.rims, noises, offsets, strict=True)
    )
    cost, _ = information_of(*reduced(here.evidence, here.state))
    score = score_state(here.evidence, here.state) + here.unmatched
    return Settled(here.evidence, here.state, here.place, fits, cost, score, rounds)
