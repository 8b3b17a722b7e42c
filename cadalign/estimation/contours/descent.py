"""Bring a model's outline to that of masks and photos, together with all other evidence.

Rounds of steps approach the outlines and learn from the residuals how accurate these are. Where
costs at several places compare, the cost at that noise is then lowered until no step does. A
Gauss-Newton step holds every rim's point on the surface: that the rim moves along the surface as
the pose changes does not count to first order. It counts where little else distinguishes poses, so
that a step is taken only as far as the distances at its end, measured anew, with all other
evidence, cost less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.contours.outline import LEAST_OFFSET, MeasuredOutline, Noise, Track
from cadalign.estimation.contours.problem import (
    OWN_MODES,
    Augmented,
    ContourProblem,
    Place,
    PosedOutlines,
    solved,
    weakest_steps,
)
from cadalign.estimation.joint_robust import with_whitening_times
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
MOST_ROUNDS = 16
"""Most rounds of an approach."""
_FEW_ITERATIONS = 4  # of a round, whose rims are not those of its end
_MOST_NOISES = 3  # that are learned, each where the cost at the last is least
_LEAST_FREEDOM = 0.1  # share of the residuals' degrees of freedom that the unknowns leave


class OutlineFit(NamedTuple):
    """An estimate, with the outlines of a look as evidence.

    The ``cost`` is that of all evidence, and of masks' samples without a rim, which is
    ``unmatched``.
    """

    look: PosedOutlines
    augmented: Augmented
    tracks: list[Track]
    cost: float = np.inf
    unmatched: float = 0.0

    @property
    def place(self) -> Place:
        """The place of the estimate."""
        return self.augmented.place

    @property
    def score(self) -> float:
        """-2 log of the probability of all evidence, at the noise of the tracks."""
        return score_state(self.augmented.evidence, self.augmented.state) + self.unmatched

    @property
    def measured(self) -> list[MeasuredOutline | None]:
        """The outline that each source measures, and its noise."""
        return [
            None if outline is None else MeasuredOutline(outline, own, track.noise)
            for outline, own, track in zip(
                self.look.outlines, self.place.own, self.tracks, strict=True
            )
        ]


class Approach(NamedTuple):
    """A place on the way to the outlines; the step that led there, with the outlines before it."""

    place: Place
    tracks: list[Track]
    step: OutlineFit | None = None

    @classmethod
    def begun(cls, problem: ContourProblem, state: State, *, is_wide: bool = False) -> Approach:
        """The start, which ``is_wide`` says may be far off."""
        tracks = [source.first(is_wide=is_wide) for source in problem.sources]
        return cls(Place.of(state, len(tracks)), tracks)

    def followed(self, problem: ContourProblem, rounds: int = MOST_ROUNDS) -> Approach | None:
        """So many rounds further, at most; None where no source shows an outline."""
        here: Approach | None = self
        for _ in range(rounds):
            if here is None or all(track.is_settled for track in here.tracks):
                break
            here = here._next(problem)
        return here

    def _next(self, problem: ContourProblem) -> Approach | None:
        look = problem.look(self.place, self.tracks)
        tracks = _learned(problem, look, self.tracks)
        augmented = problem.augmented(look, [track.noise for track in tracks])
        there = None if augmented is None else augmented.refined(_FEW_ITERATIONS)
        if there is None:
            return None
        tracks, own = with_learned_offsets(there, tracks, there.place.own, problem.learning)
        moves = problem.moves(look, there)
        advanced = [
            source.advanced(track, outline, moved)
            for source, track, outline, moved in zip(
                problem.sources, tracks, look.outlines, moves, strict=True
            )
        ]
        step = OutlineFit(look, there, advanced)
        return Approach(there.place._replace(own=own), advanced, step)


class Descent(NamedTuple):
    """Steps that lower the cost of masks at a known noise.

    The ``others`` are estimates from other starts, towards which the cost is tried, too.
    """

    problem: ContourProblem
    tracks: list[Track]
    others: Sequence[Place] = ()

    def at(self, place: Place) -> OutlineFit | None:
        """The outlines of a place as evidence; None where there are none."""
        return self.stacked(self.problem.look(place, self.tracks))

    def stacked(self, look: PosedOutlines) -> OutlineFit | None:
        """The outlines of a look as evidence; None where there are none."""
        augmented = self.problem.augmented(look, [track.noise for track in self.tracks])
        if augmented is None:
            return None
        unmatched = sum(
            track.noise.cost(track.reach) * int((~outline.found).sum())
            for outline, track in zip(look.outlines, self.tracks, strict=True)
            if outline is not None
        )
        cost = objective_of(augmented.evidence, augmented.state) + unmatched
        return OutlineFit(look, augmented, self.tracks, cost, unmatched)

    def run(self, here: OutlineFit) -> OutlineFit:
        """The place where no step lowers the cost.

        Pixels make the cost rough: where whole steps don't lower it, the least is tried for shorter
        ones and for others.
        """
        for _ in range(_MOST_STEPS):
            better = self._stepped(here) or self._elsewhere(here)
            if better is None:
                break
            here = better
        return here

    def _stepped(self, here: OutlineFit) -> OutlineFit | None:
        """A place that costs less after whole steps, or on the way to the goal of the first.

        Steps go on for a while where they don't lower the cost.
        """
        goal = here.augmented.refined(_ITERATIONS)
        if goal is None:
            return None
        last = here
        for _ in range(_PATIENCE):
            step = goal if last is here else last.augmented.refined(_ITERATIONS)
            there = None if step is None else self.at(step.place)
            if there is None:
                break
            if there.cost < here.cost - _LEAST_GAIN:
                return there
            last = there
        for share in _SHARES:
            there = self.at(here.place.towards(goal.place, share))
            if there is not None and there.cost < here.cost - _LEAST_GAIN:
                return there
        return None

    def _elsewhere(self, here: OutlineFit) -> OutlineFit | None:
        """A place that costs less along the directions of which least is known, or to others."""
        if not self.problem.surface.is_exact:
            return None
        _, information = information_of(here.augmented.evidence, here.augmented.state)
        steps = weakest_steps(information, _WEAKEST)
        goals = [here.place.moved(sign * step) for step in steps for sign in (1.0, -1.0)]
        goals.extend(
            here.place.towards(other, share) for other in self.others for share in _SHARES_OF_OTHERS
        )
        found = [each for each in map(self.at, goals) if each is not None]
        best = min(found, key=lambda each: each.cost, default=here)
        return best if best.cost < here.cost - _LEAST_GAIN else None


def first_fit(problem: ContourProblem, state: State, *, is_wide: bool = False) -> OutlineFit | None:
    """The estimate near a start, which ``is_wide`` says may be far off; None without an outline.

    Where costs compare it has the least cost nearby, at the noise that is learned on the way.
    """
    here = Approach.begun(problem, state, is_wide=is_wide).followed(problem)
    if here is None:
        return None
    return _lowered(problem, here) if problem.is_comparable else here.step


def last_fit(
    problem: ContourProblem, place: Place, tracks: Sequence[Track], others: Sequence[Place] = ()
) -> OutlineFit | None:
    """The estimate near another one at a place, with the noise of ``tracks`` where costs compare.

    ``others`` are estimates from other starts, towards which the cost is tried, too.
    """
    tracks = [source.last(track) for source, track in zip(problem.sources, tracks, strict=True)]
    if problem.is_comparable:
        descent = Descent(problem, tracks, others)
        start = descent.at(place)
        return None if start is None else descent.run(start)
    here = Approach(place, tracks).followed(problem)
    return None if here is None or here.step is None else _with_wider_noise(problem, here.step)


def _lowered(problem: ContourProblem, here: Approach) -> OutlineFit | None:
    """The least cost near the end of an approach, at the noise that its residuals show."""
    is_exact = problem.surface.is_exact
    found: OutlineFit | None = None
    descent = Descent(problem, [track._replace(is_fine=is_exact) for track in here.tracks])
    look = problem.look(here.place, descent.tracks)
    for _ in range(_MOST_NOISES):
        learned = _learned(problem, look, descent.tracks)
        if found is not None:
            own, learning = look.place.own, problem.learning
            learned, own = with_learned_offsets(found.augmented, learned, own, learning)
            look = look._replace(place=look.place._replace(own=own))
            before = [track.noise for track in descent.tracks]
            if not is_exact or all(map(Noise.is_like, before, [each.noise for each in learned])):
                break  # a similar surface's noise is learned on the way
        descent = descent._replace(tracks=learned)
        start = descent.stacked(look)
        if start is None:
            return None
        found = descent.run(start)
        look = found.look
    return found


def _learned(problem: ContourProblem, look: PosedOutlines, tracks: Sequence[Track]) -> list[Track]:
    """The tracks with the noise that the residuals of a look show."""
    return [
        track if outline is None else source.learned(outline, own, track)
        for source, track, outline, own in zip(
            problem.sources, tracks, look.outlines, look.place.own, strict=True
        )
    ]


def with_learned_offsets(
    there: Augmented, tracks: Sequence[Track], own: FloatArray, learning: IntArray
) -> tuple[list[Track], FloatArray]:
    """Tracks with the deviations of the offsets that masks ``learning`` (L,) have by likelihood.

    All contours' ``own`` coefficients (V, 3), last of the evidence's unknowns, come along.
    """
    learned, own = list(tracks), own.copy()
    if not len(learning):
        return learned, own
    _, information = information_of(there.evidence, there.state)
    size = len(information)
    rows = size - own.size + OWN_MODES * learning
    variances = solved(information, np.eye(size)[:, rows])[rows].diagonal()
    for number, variance in zip(learning, variances, strict=True):
        noise = learned[number].noise
        without_prior = 1 / max(1 / min(variance, 1.0) - 1, 1e-6)  # in squares of the offset
        free = own[number, 0] * (1 + without_prior)
        square = noise.offset**2 * max(free**2 - without_prior, 0.0)
        offset = max(float(np.sqrt(square)), LEAST_OFFSET)
        learned[number] = learned[number]._replace(noise=noise._replace(offset=offset))
        own[number, 0] *= noise.offset / offset
    return learned, own


def _with_wider_noise(problem: ContourProblem, fit: OutlineFit) -> OutlineFit:
    """The same, with the noise of photos' lines as large as if unknowns fitted a part of it.

    Their residuals have as many degrees of freedom less as the lines determine unknowns.
    """
    augmented = fit.augmented
    is_line = np.zeros(len(problem.evidence.sightings.point), dtype=bool)
    for source, rows in zip(problem.sources, augmented.rows, strict=True):
        count = 0 if rows is None else len(rows.mean)
        is_line = np.append(is_line, np.full(count, not source.is_comparable))

    (_, whole), (_, rest) = (
        information_of(with_whitening_times(lines, is_line, augmented.evidence), augmented.state)
        for lines in (1.0, 0.0)
    )
    fitted = float(np.trace(solved(whole, whole - rest)))
    independent = sum(
        float(outline.found.sum()) / track.noise.correlation
        for source, outline, track in zip(
            problem.sources, fit.look.outlines, fit.tracks, strict=True
        )
        if outline is not None and not source.is_comparable
    )
    factor = np.sqrt(max(1 - fitted / max(independent, 1.0), _LEAST_FREEDOM))
    wider = with_whitening_times(factor, is_line, augmented.evidence)
    return fit._replace(augmented=augmented._replace(evidence=wider))
