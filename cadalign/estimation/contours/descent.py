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
from cadalign.solvers.joint.search import score_state

_MOST_ROUNDS = 16
_FEW_ITERATIONS = 4  # of a round, whose rims are not those of its end
_ITERATIONS = 12
_MOST_STEPS = 20
_MOST_NOISES = 2  # that a descent learns
_PATIENCE = 2  # steps that don't lower the cost
_LEAST_GAIN = 0.3  # of the cost, -2 log likelihood
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
            outline and MeasuredOutline(outline, own[0] * track.noise.offset, track.noise)
            for outline, own, track in zip(
                self.look.outlines, self.place.own, self.tracks, strict=True
            )
        ]


def first_fit(problem: ContourProblem, state: State) -> OutlineFit | None:
    """The estimate that rounds of steps from a start lead to; None without an outline."""
    tracks = [source.first() for source in problem.sources]
    return _approached(problem, Place.of(state, len(tracks)), tracks)


def last_fit(
    problem: ContourProblem, fit: OutlineFit, tracks: Sequence[Track] | None = None
) -> OutlineFit | None:
    """The end near another estimate; None without an outline.

    Where costs compare, it has the least cost at the noise of ``tracks``, which is learned without
    them.
    """
    begun = fit.tracks if tracks is None else tracks
    begun = [source.last(track) for source, track in zip(problem.sources, begun, strict=True)]
    if not problem.is_comparable:
        end = _approached(problem, fit.place, begun)
        return None if end is None else _with_wider_noise(problem, end)
    start = fit_at(problem, fit.place, begun)
    if start is None:
        return None
    if tracks is not None:
        return descended(problem, start)
    start = _costed(problem, start.look, _learned(problem, start.look, begun)) or start
    return descended(problem, start, learns=True)


def _approached(
    problem: ContourProblem, place: Place, tracks: Sequence[Track]
) -> OutlineFit | None:
    """The last of some rounds, each with the noise that the residuals before its step show."""
    fit: OutlineFit | None = None
    for _ in range(_MOST_ROUNDS):
        look = problem.look(place, tracks)
        learned = _learned(problem, look, tracks)
        here = problem.augmented(look, learned)
        there = None if here is None else here.refined(_FEW_ITERATIONS)
        if here is None or there is None:
            return None
        learned, place = _with_likeliest_offsets(problem, there, learned)
        fit = OutlineFit(look, there._replace(place=place), learned)
        is_settled = not problem.is_comparable or all(map(Track.is_like, learned, tracks))
        if is_settled and not any(track.levels for track in tracks):
            break
        tracks = [track.next for track in learned]
    return fit


def fit_at(problem: ContourProblem, place: Place, tracks: Sequence[Track]) -> OutlineFit | None:
    """The outlines of a place as evidence, and what they cost; None where there are none."""
    return _costed(problem, problem.look(place, tracks), tracks)


def _costed(
    problem: ContourProblem, look: PosedOutlines, tracks: Sequence[Track]
) -> OutlineFit | None:
    augmented = problem.augmented(look, tracks)
    if augmented is None:
        return None
    unmatched = sum(
        float(track.noise.costs(np.full((~outline.found).sum(), track.reach)).sum())
        for outline, track in zip(look.outlines, tracks, strict=True)
        if outline is not None
    )
    return OutlineFit(look, augmented, list(tracks), augmented.objective + unmatched, unmatched)


def descended(problem: ContourProblem, here: OutlineFit, *, learns: bool = False) -> OutlineFit:
    """The place where no step lowers the cost, at the noise of a fit, or what it learns on the way.

    Pixels make the cost rough: where whole steps don't lower it, the noise is learned anew
    and others are tried.
    """
    noises = _MOST_NOISES if learns else 0
    is_searched = False  # along the direction of which least is known
    for _ in range(_MOST_STEPS):
        better = _stepped(problem, here)
        if better is None and noises:
            again = _relearned(problem, here)
            if not all(map(Track.is_like, again.tracks, here.tracks)):
                better, noises = again, noises - 1
        if better is None and not is_searched:
            better, is_searched = _elsewhere(problem, here), True
        else:
            is_searched = False
        if better is None:
            break
        here = better
    return here


def _stepped(problem: ContourProblem, here: OutlineFit) -> OutlineFit | None:
    """A place that costs less after whole steps, which go on for a while where they don't."""
    there = here
    for _ in range(_PATIENCE):
        step = there.augmented.refined(_ITERATIONS)
        after = None if step is None else fit_at(problem, step.place, here.tracks)
        if after is None or after.cost < here.cost - _LEAST_GAIN:
            return after
        there = after
    return None


def _elsewhere(problem: ContourProblem, here: OutlineFit) -> OutlineFit | None:
    """The first place along the direction of which least is known where no step costs less."""
    if not problem.surface.is_exact:
        return None
    _, information = information_of(here.augmented.evidence, here.augmented.state)
    (step,) = weakest_steps(information, 1)
    best = here
    for sign in (1.0, -1.0):
        for _ in range(_MOST_STEPS):
            there = fit_at(problem, best.place.moved(sign * step), here.tracks)
            if there is None or not there.cost < best.cost - _LEAST_GAIN:
                break
            best = there
        if best is not here:
            return best
    return None


def _learned(problem: ContourProblem, look: PosedOutlines, tracks: Sequence[Track]) -> list[Track]:
    """The tracks with the noise that the residuals of a look show."""
    return [
        track
        if outline is None
        else source.learned(outline, float(own[0]) * track.noise.offset, track)
        for source, track, outline, own in zip(
            problem.sources, tracks, look.outlines, look.place.own, strict=True
        )
    ]


def _with_likeliest_offsets(
    problem: ContourProblem, augmented: Augmented, tracks: Sequence[Track]
) -> tuple[list[Track], Place]:
    """Tracks whose offsets have the likeliest deviations, and the place in terms of these.

    All contours' own coefficients are the last of the evidence's unknowns.
    """
    learned, own, learning = list(tracks), augmented.place.own.copy(), problem.learning
    if len(learning):
        _, information = information_of(augmented.evidence, augmented.state)
        rows = len(information) - own.size + OWN_MODES * learning
        variances = solved(information, np.eye(len(information))[:, rows])[rows].diagonal()
        for number, variance in zip(learning, variances, strict=True):
            noise = learned[number].noise
            offset = likeliest_offset(own[number, 0], variance, noise)
            learned[number] = learned[number]._replace(noise=noise._replace(offset=offset))
            own[number, 0] *= noise.offset / offset
    return learned, augmented.place._replace(own=own)


def _relearned(problem: ContourProblem, fit: OutlineFit) -> OutlineFit:
    """The same at the noise that the residuals show."""
    learned = _learned(problem, fit.look, fit.tracks)
    tracks, place = _with_likeliest_offsets(problem, fit.augmented, learned)
    return _costed(problem, fit.look._replace(place=place), tracks) or fit


def likeliest_offset(own: float, variance: float, noise: Noise) -> float:
    """Likeliest standard deviation [px] of an offset of the coefficient ``own``.

    The ``variance`` is that of the coefficient, whose prior is that of the ``noise``.
    """
    without_prior = 1 / max(1 / min(variance, 1.0) - 1, 1e-6)  # in squares of the offset
    free = own * (1 + without_prior)
    square = noise.offset**2 * max(free**2 - without_prior, 0.0)
    return max(float(np.sqrt(square)), LEAST_OFFSET)


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
