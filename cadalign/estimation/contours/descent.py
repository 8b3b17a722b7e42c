"""Fit the model's rim to masks' contours, together with all other evidence.

Rounds of steps approach the contours and learn from the residuals how accurate these are; then the
cost at that noise is lowered until no step does. A Gauss-Newton step holds every rim's point on the
surface: that the rim moves along the surface as the pose changes does not count to first order. It
counts where little else tells poses apart, so that a step is taken only as far as the distances at
its end, measured anew, with all other evidence, cost less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.rims import Rims, extraction_bias, find_rims
from cadalign.estimation.contours.surface import (
    PosedSurface,
    Surface,
    count_of,
    state_with_points,
    state_without_points,
    with_measured,
)
from cadalign.estimation.contours.view_contour import (
    OWN_MODES,
    Noise,
    ViewContour,
    first_noise,
    noise_of,
    noise_of_similar,
    with_learned_offsets,
)
from cadalign.estimation.estimates import poses_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_vector, vector_from_rotation
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.search import objective_of, reduced, refine_joint, score_state

_ITERATIONS = 12
_MOST_STEPS = 20
_PATIENCE = 2  # steps that don't lower the cost
_SHARES = (0.4, 0.1)  # of a step, until one lowers the cost
_SHARES_OF_OTHERS = (0.5, 0.25)  # of the way to another estimate
_LEAST_GAIN = 0.1  # of the cost, -2 log likelihood
_WEAKEST = 2  # directions that are tried before a descent ends
_LEAST_INFORMATION = 1e-12  # about a direction of the unknowns, relative
_FIRST_REACH = 24.0  # [px], and the same relative to the contour's size
_RELATIVE_REACH = 0.04
_WIDE_REACH = 0.15  # where nothing but the masks determines the estimate
_LEAST_REACH = 4.0
_REACH = 6.0  # in deviations of the residuals
_MOST_ROUNDS = 16
_FEW_ITERATIONS = 4  # of a round, whose rims are not those of its end
_SETTLED = 0.02  # [px], median change of the offsets from round to round, or in deviations
_MOST_NOISES = 3  # that are learned, each where the cost at the last is least


class Masked(NamedTuple):
    """Evidence with the contours of masks, and the surface whose rims are to meet these."""

    evidence: Evidence
    keypoints: int
    views: list[ViewContour]
    surface: Surface


class Place(NamedTuple):
    """A state of the evidence, and the coefficients (V, 3) of the contours' own modes."""

    state: State
    own: FloatArray

    def towards(self, other: Place, share: float) -> Place:
        """The place a share of the way to another one."""
        a, b = self.state, other.state
        poses = a.poses + share * (b.poses - a.poses)
        for pose, start, end in zip(poses, a.poses, b.poses, strict=True):
            turn = end[:9].reshape(3, 3) @ start[:9].reshape(3, 3).T
            part = rotation_from_vector(share * vector_from_rotation(turn))
            pose[:9] = (part @ start[:9].reshape(3, 3)).ravel()
        rest = [x + share * (y - x) for x, y in zip(a[1:], b[1:], strict=True)]
        return Place(State(poses, *rest), self.own + share * (other.own - self.own))

    def moved(self, step: FloatArray) -> Place:
        """The place after a step (U,) of poses, focal lengths, scales and own modes."""
        state, count = self.state, len(self.state.poses)
        poses = state.poses.copy()
        steps, focals, scales, own = np.split(
            step, np.cumsum([6 * count, len(state.log_focals), 3])
        )
        for pose, part in zip(poses, steps.reshape(-1, 6), strict=True):
            pose[:9] = (rotation_from_vector(part[:3]) @ pose[:9].reshape(3, 3)).ravel()
            pose[9:] += part[3:]
        moved = state._replace(
            poses=poses,
            log_focals=state.log_focals + focals,
            log_scales=state.log_scales + scales,
        )
        return Place(moved, self.own + own.reshape(self.own.shape))


class PlacedRims(NamedTuple):
    """Rims at a place: of every contour, with its camera and the bias of its extraction."""

    posed: PosedSurface
    poses: list[Alignment]
    cameras: list[Camera]
    rims: list[Rims]
    biases: list[FloatArray]


class Stacked(NamedTuple):
    """A place with its rims as evidence.

    The ``cost`` is that of all evidence at the place, and of the samples without a rim, which is
    ``unmatched``; ``rows`` are the numbers of keypoints and of the rims' points that follow these.
    """

    place: Place
    look: PlacedRims
    evidence: Evidence
    state: State
    cost: float
    unmatched: float
    rows: tuple[int, int]

    def at(self, place: Place) -> State:
        """Another place as a state of the evidence."""
        keypoints, total = self.rows
        return state_with_points(place.state, keypoints, total, place.own.ravel())


def rims_at(masked: Masked, place: Place, reach: float, *, is_fine: bool) -> PlacedRims:
    """Find the rims at a place; ``is_fine`` measures the bias of their extraction, too."""
    evidence, (state, own) = masked.evidence, place
    posed, poses = masked.surface.at(evidence.shape, state), poses_of(evidence, state)
    cameras, rims, biases = [], [], []
    for view, coefficients in zip(masked.views, own, strict=True):
        camera, pose = view.camera_at(evidence, state, coefficients), poses[view.image]
        found = find_rims(posed.caster, camera, pose, view.contour, reach)
        bias = np.zeros(len(found.found))
        if is_fine:
            bias = extraction_bias(posed.caster, camera, pose, view.mask, view.contour, found)
        cameras.append(camera)
        rims.append(found)
        biases.append(bias)
    return PlacedRims(posed, poses, cameras, rims, biases)


def stack(
    masked: Masked, place: Place, look: PlacedRims, noises: list[Noise], reach: float
) -> Stacked | None:
    """The rims of a place as evidence; None where there are none."""
    rows = [
        view.evidence_of(rims, noise, look.posed, look.poses[view.image], camera=camera, bias=bias)
        for view, noise, camera, rims, bias in zip(
            masked.views, noises, look.cameras, look.rims, look.biases, strict=True
        )
    ]
    total = count_of(rows)
    if not total:
        return None
    full = with_measured(masked.evidence, masked.keypoints, rows)
    state = state_with_points(place.state, masked.keypoints, total, place.own.ravel())
    unmatched = sum(
        noise.cost(reach) * int((~rims.found).sum())
        for rims, noise in zip(look.rims, noises, strict=True)
    )
    cost = objective_of(full, state) + unmatched
    return Stacked(place, look, full, state, cost, unmatched, (masked.keypoints, total))


def step_of(masked: Masked, here: Stacked, iterations: int = _ITERATIONS) -> Place | None:
    """The place where all evidence agrees best if every rim's point stays, or None."""
    cost, state, _, _ = refine_joint(here.evidence, iterations, here.state)
    if not cost < np.inf:
        return None
    bare, own = state_without_points(state, *here.rows, OWN_MODES * len(masked.views))
    return Place(bare, own.reshape(-1, OWN_MODES))


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

    def run(self, here: Stacked) -> tuple[Stacked, int]:
        """The place where no step lowers the cost, and the number of steps.

        Pixels make the cost rough: whole steps go on for a while where they don't lower it, before
        the least is tried for shorter ones and for others.
        """
        best, steps, since = here, 0, 0
        while steps < _MOST_STEPS:
            steps += 1
            goal = step_of(self.masked, here)
            there = None if goal is None else self.at(goal)
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
        return best, steps

    def _shorter(self, here: Stacked) -> Stacked | None:
        """The first place on the way to the goal of a step that costs less."""
        goal = step_of(self.masked, here)
        if goal is None:
            return None
        for share in _SHARES:
            there = self.at(here.place.towards(goal, share))
            if there is not None and there.cost < here.cost - _LEAST_GAIN:
                return there
        return None

    def _elsewhere(self, here: Stacked) -> Stacked | None:
        """A place that costs less along the directions of which least is known, or to others."""
        if not self.masked.surface.is_exact:
            return None
        goals = [
            here.place.moved(sign * step) for step in _weakest_steps(here) for sign in (1.0, -1.0)
        ]
        goals.extend(
            here.place.towards(other, share) for other in self.others for share in _SHARES_OF_OTHERS
        )
        found = [each for each in map(self.at, goals) if each is not None]
        best = min(found, key=lambda each: each.cost, default=here)
        return best if best.cost < here.cost - _LEAST_GAIN else None


def _weakest_steps(here: Stacked) -> list[FloatArray]:
    """Steps (U,) of one standard deviation along the directions of which least is known."""
    _, information = information_of(here.evidence, here.state)
    sizes = np.sqrt(np.maximum(information.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(sizes, sizes))
    roots = np.sqrt(np.maximum(values[:_WEAKEST], _LEAST_INFORMATION))
    return list((vectors[:, :_WEAKEST] / roots / sizes[:, None]).T)


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


def settle(masked: Masked, state: State, *, is_wide: bool = False) -> Settled | None:
    """Descend from one start; None where no rim comes near a contour.

    ``is_wide`` says that the start may be far off.
    """
    first_reach = _first_reach(masked, _WIDE_REACH if is_wide else _RELATIVE_REACH)
    approached = _approach(
        masked, Place(state, np.zeros((len(masked.views), OWN_MODES))), first_reach
    )
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


class Approached(NamedTuple):
    """Place after the first steps from a start.

    ``residuals`` (S,) are the contours' distances from the rims there [px], without the offset that
    all of a contour has in common, and at most ``reach``.
    """

    state: State
    residuals: FloatArray
    reach: float


def approached(masked: Masked, state: State) -> Approached | None:
    """Take the first steps of `settle` from a start that may be far off."""
    reach = _first_reach(masked, _WIDE_REACH)
    own = np.zeros((len(masked.views), OWN_MODES))
    found = _approach(masked, Place(state, own), reach)
    if found is None:
        return None
    place, noises = found[:2]
    look = rims_at(masked, place, reach, is_fine=False)
    residuals = [
        np.where(rims.found, np.abs(rims.offset + own_offset * noise.offset), reach)
        for rims, own_offset, noise in zip(look.rims, place.own[:, 0], noises, strict=True)
    ]
    return Approached(place.state, np.minimum(np.concatenate(residuals), reach), reach)


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
