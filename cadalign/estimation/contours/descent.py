"""Fit the model's rim to masks' contours, together with all other evidence.

Rounds of steps approach the contours and learn from the residuals how accurate these are; then the
cost at that noise is lowered until no step does. A Gauss-Newton step holds every rim's point on the
surface: that the rim moves along the surface as the pose changes does not count to first order. It
counts where little else distinguishes poses, so that a step is taken only as far as the distances
at its end, measured anew, with all other evidence, cost less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.contour import (
    ROUGH,
    Rims,
    Sight,
    extraction_bias,
    find_rims,
    without_steep,
)
from cadalign.estimation.contours.measured import Joined, Place, Sought, cost_of, weakest_steps
from cadalign.estimation.contours.surface import PosedSurface
from cadalign.estimation.contours.view_contour import (
    Noise,
    ViewContour,
    first_noise,
    noise_of,
    noise_of_similar,
    with_learned_offsets,
)
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import State
from cadalign.solvers.joint.search import objective_of, score_state

_ITERATIONS = 12
_MOST_STEPS = 20
_PATIENCE = 2  # steps that don't lower the cost
_SHARES = (0.4, 0.1)  # of a step, until one lowers the cost
_SHARES_OF_OTHERS = (0.5, 0.25)  # of the way to another estimate
_LEAST_GAIN = 0.1  # of the cost, -2 log likelihood
_WEAKEST = 2  # directions that are tried before a descent ends
_FIRST_REACH = 24.0  # [px], and the same relative to the contour's size
_RELATIVE_REACH = 0.04
_WIDE_REACH = 0.15  # where nothing but the masks determines the estimate
_LEAST_REACH = 4.0
_REACH = 6.0  # in standard deviations of the residuals
_OFFSETS = 2.0  # in standard deviations of the offset that all of a contour has in common
MOST_ROUNDS = 16
"""Most of the `FirstSteps`."""
_FEW_ITERATIONS = 4  # of a round, whose rims are not those of its end
_SETTLED = 0.02  # [px], median change of the offsets from round to round, or in standard deviations
_MOST_NOISES = 3  # that are learned, each where the cost at the last is least

Masked = Sought[ViewContour]
"""Evidence with the contours of masks, and the surface whose rims are to meet these."""


class PlacedRims(NamedTuple):
    """Rims at a place: of every contour, as its view sees them, with the extraction's bias."""

    posed: PosedSurface
    sights: list[Sight]
    rims: list[Rims]
    biases: list[FloatArray]


class Stacked(NamedTuple):
    """A place with its rims as evidence.

    The ``cost`` is that of all evidence at the place, and of the samples without a rim, which is
    ``unmatched``.
    """

    joined: Joined
    look: PlacedRims
    cost: float
    unmatched: float

    @property
    def place(self) -> Place:
        """The place, without the rims."""
        return self.joined.place


def rims_at(masked: Masked, place: Place, reach: float, *, is_fine: bool) -> PlacedRims:
    """Find the rims at a place; ``is_fine`` measures the bias of their extraction, too."""
    posed, poses = masked.at(place.state)
    sights, rims, biases = [], [], []
    for view, own in zip(masked.views, place.own, strict=True):
        camera = view.registered(masked.camera_at(view.image, view.camera, place.state), own)
        sight = Sight(posed.caster, camera, poses[view.image])
        if is_fine:
            found = find_rims(sight, view.contour, reach, ROUGH)
            bias = extraction_bias(sight, view.mask, view.contour, found)
        else:
            found = find_rims(sight, view.contour, reach)
            bias = np.zeros(len(found.found))
        sights.append(sight)
        rims.append(without_steep(view.contour, found, bias))
        biases.append(bias)
    return PlacedRims(posed, sights, rims, biases)


def stack(
    masked: Masked, place: Place, look: PlacedRims, noises: list[Noise], reach: float
) -> Stacked | None:
    """The rims of a place as evidence; None where there are none."""
    rows = [
        view.evidence_of(rims, noise, look.posed, sight, bias)
        for view, noise, sight, rims, bias in zip(
            masked.views, noises, look.sights, look.rims, look.biases, strict=True
        )
    ]
    if not any(len(each.mean) for each in rows):
        return None
    joined = masked.joined(place, rows)
    unmatched = sum(
        noise.cost(reach) * int((~rims.found).sum())
        for rims, noise in zip(look.rims, noises, strict=True)
    )
    return Stacked(joined, look, objective_of(joined.evidence, joined.state) + unmatched, unmatched)


class Descent(NamedTuple):
    """Steps that lower the cost at a known noise; ``others`` are estimates from other starts."""

    masked: Masked
    noises: list[Noise]
    reach: float
    others: Sequence[Place] = ()

    def at(self, place: Place) -> Stacked | None:
        """The rims of a place as evidence; None where there are none."""
        look = rims_at(self.masked, place, self.reach, is_fine=self.masked.surface.is_exact)
        return stack(self.masked, place, look, self.noises, self.reach)

    def run(self, here: Stacked) -> Stacked:
        """The place where no step lowers the cost.

        Pixels make the cost rough: whole steps go on for a while where they don't lower it, before
        the least is tried for shorter ones and for others.
        """
        best, since = here, 0
        for _ in range(_MOST_STEPS):
            step = here.joined.refined(_ITERATIONS)
            there = None if step is None else self.at(step[1].place)
            if there is not None and there.cost < best.cost - _LEAST_GAIN:
                here = best = there
                since = 0
                continue
            since += 1
            if there is not None and since < _PATIENCE:
                here = there
                continue
            better = self._shorter(best) or self._elsewhere(best)
            if better is None:
                break
            here = best = better
            since = 0
        return best

    def _shorter(self, here: Stacked) -> Stacked | None:
        """The first place on the way to the goal of a step that costs less."""
        step = here.joined.refined(_ITERATIONS)
        if step is None:
            return None
        for share in _SHARES:
            there = self.at(here.place.towards(step[1].place, share))
            if there is not None and there.cost < here.cost - _LEAST_GAIN:
                return there
        return None

    def _elsewhere(self, here: Stacked) -> Stacked | None:
        """A place that costs less along the directions of which least is known, or to others."""
        if not self.masked.surface.is_exact:
            return None
        _, information = information_of(here.joined.evidence, here.joined.state)
        steps = weakest_steps(information, _WEAKEST)
        goals = [here.place.moved(sign * step) for step in steps for sign in (1.0, -1.0)]
        goals.extend(
            here.place.towards(other, share) for other in self.others for share in _SHARES_OF_OTHERS
        )
        found = [each for each in map(self.at, goals) if each is not None]
        best = min(found, key=lambda each: each.cost, default=here)
        return best if best.cost < here.cost - _LEAST_GAIN else None


class ContourFit(NamedTuple):
    """A view's contour at an estimate: residuals (S,) [px] with the offset removed, noise."""

    residuals: FloatArray
    noise: Noise
    offset: float


class Settled(NamedTuple):
    """An estimate, with its rims as evidence."""

    joined: Joined
    fits: tuple[ContourFit, ...]
    cost: float
    score: float

    @property
    def noises(self) -> list[Noise]:
        """The noise of every contour."""
        return [fit.noise for fit in self.fits]


class FirstSteps(NamedTuple):
    """First steps towards contours, which learn the noise from the residuals.

    The rims at the ``place`` were sought within a ``reach`` [px], at first ``first_reach``. They
    ``is_settled`` where the last step changed the rims little.
    """

    place: Place
    noises: list[Noise]
    reach: float
    first_reach: float
    look: PlacedRims
    is_settled: bool = False

    @classmethod
    def begun(cls, masked: Masked, state: State, *, is_wide: bool = False) -> FirstSteps:
        """The start; ``is_wide`` says that it may be far off."""
        place = Place.of(state, len(masked.views))
        reach = _first_reach(masked, _WIDE_REACH if is_wide else _RELATIVE_REACH)
        is_exact = masked.surface.is_exact
        noises = [first_noise(view.sigma, reach, is_exact=is_exact) for view in masked.views]
        return cls(place, noises, reach, reach, rims_at(masked, place, reach, is_fine=False))

    def followed(self, masked: Masked, steps: int = MOST_ROUNDS) -> FirstSteps | None:
        """So many steps further, at most; None where no rim comes near a contour."""
        here: FirstSteps | None = self
        for _ in range(steps):
            if here is None or here.is_settled:
                break
            here = here._next(masked)
        return here

    def residuals(self) -> FloatArray:
        """Signed distances (S,) of the contours from the rims [px], as far as `first_reach`.

        They are without the offset that all of a contour has in common.
        """
        far = self.first_reach
        found = [
            np.where(rims.found, rims.offset + own_offset * noise.offset, far)
            for rims, own_offset, noise in zip(
                self.look.rims, self.place.own[:, 0], self.noises, strict=True
            )
        ]
        return np.asarray(np.clip(np.concatenate(found), -far, far))

    def widened(self, masked: Masked) -> FirstSteps:
        """The same with the rims within the first reach."""
        look = rims_at(masked, self.place, self.first_reach, is_fine=False)
        return self._replace(look=look)

    def _next(self, masked: Masked) -> FirstSteps | None:
        place, noises, reach, first_reach, look, _ = self
        is_exact = masked.surface.is_exact
        noises = _learned(masked, place, look, noises, reach, correlated=False)
        if is_exact:
            reach = min(reach, _reach_of(noises))
        here = stack(masked, place, look, noises, reach)
        step = None if here is None else here.joined.refined(_FEW_ITERATIONS)
        if step is None:
            return None
        _, joined = step
        place = joined.place
        if is_exact:
            noises, own = with_learned_offsets(joined.evidence, joined.state, noises, place.own)
            place = place._replace(own=own)
        there = rims_at(masked, place, reach, is_fine=False)
        widest = max(noise.sigma for noise in noises)
        is_settled = _change(look.rims, there.rims) < _SETTLED * max(1.0, widest)
        return FirstSteps(place, noises, reach, first_reach, there, is_settled)


def settle(masked: Masked, state: State, *, is_wide: bool = False) -> Settled | None:
    """Descend from one start; None where no rim comes near a contour.

    ``is_wide`` says that the start may be far off.
    """
    start = FirstSteps.begun(masked, state, is_wide=is_wide)
    found = start.followed(masked)
    if found is None:
        return None
    place, noises, reach = found.place, found.noises, found.reach
    is_exact, here = masked.surface.is_exact, None
    look = rims_at(masked, place, reach, is_fine=True) if is_exact else found.look
    for _ in range(_MOST_NOISES):
        learned = _learned(masked, place, look, noises, reach, correlated=True)
        if here is not None and is_exact:
            joined = here.joined
            learned, own = with_learned_offsets(joined.evidence, joined.state, learned, place.own)
            place = place._replace(own=own)
        if here is not None and (not is_exact or all(map(Noise.is_like, noises, learned))):
            break  # a similar surface's noise is learned on the way
        noises = learned
        here = stack(masked, place, look, noises, reach)
        if here is None:
            return None
        here = Descent(masked, noises, reach).run(here)
        place, look = here.place, here.look
    return None if here is None else _settled(here, noises)


def settle_with(
    masked: Masked, place: Place, noises: list[Noise], others: Sequence[Place] = ()
) -> Settled | None:
    """Descend at a known noise, so that the scores of several estimates compare.

    ``others`` are estimates from other starts, towards which the cost is tried, too.
    """
    reach = min(_first_reach(masked, _RELATIVE_REACH), _reach_of(noises))
    descent = Descent(masked, noises, reach, others)
    here = descent.at(place)
    return None if here is None else _settled(descent.run(here), noises)


def _first_reach(masked: Masked, share: float) -> float:
    return max(_FIRST_REACH, *(share * view.contour.size for view in masked.views))


def _reach_of(noises: list[Noise]) -> float:
    least = max(_LEAST_REACH, *(_OFFSETS * noise.offset for noise in noises))
    return max(_REACH * max(noise.sigma for noise in noises), least)


def _change(last: list[Rims], rims: list[Rims]) -> float:
    """Median change of the rims' offsets [px] since the last step."""
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


def _settled(here: Stacked, noises: list[Noise]) -> Settled:
    joined = here.joined
    fits = []
    for own, rims, noise in zip(here.place.own, here.look.rims, noises, strict=True):
        offset = own[0] * noise.offset
        residuals = np.where(rims.found, rims.offset + offset, np.nan)
        fits.append(ContourFit(residuals, noise, offset))
    score = score_state(joined.evidence, joined.state) + here.unmatched
    return Settled(joined, tuple(fits), cost_of(joined.evidence, joined.state), score)
