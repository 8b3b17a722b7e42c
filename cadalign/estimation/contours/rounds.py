"""Bring a model's outline to that of masks and photos, together with all other evidence.

Every round measures the outlines at a state, learns from the residuals how accurate these are, and
takes steps that hold every rim's point on the surface: that the rim moves along the surface as the
pose changes does not count to first order, and the next round finds it anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.contours.outline import (
    LEAST_OFFSET,
    MeasuredOutline,
    Noise,
    Outline,
    Track,
)
from cadalign.estimation.contours.problem import OWN_MODES, OutlineProblem
from cadalign.estimation.search import with_whitening_times
from cadalign.solvers.joint.covariance import information_of, scaled_information
from cadalign.solvers.joint.evidence import Evidence, State
from cadalign.solvers.joint.search import objective_of, refine_joint

_MOST_ROUNDS = 16
_ITERATIONS = 4  # of a round, whose rims are not those of its end
_LEAST_GAIN = 2.0  # of the objective, -2 log likelihood, in a round
_LEAST_FREEDOM = 0.1  # share of the residuals' degrees of freedom that the unknowns leave
_LEAST_INFORMATION = 1e-12  # about a direction of the unknowns, relative


class OutlineFit(NamedTuple):
    """An estimate, and the ``outlines`` from which the last round led there.

    Evidence and state are those ``with_outlines``, the ``state`` that without their points.
    """

    problem: OutlineProblem
    with_outlines: tuple[Evidence, State]
    state: State
    outlines: list[Outline | None]
    tracks: list[Track]

    @property
    def measured(self) -> list[MeasuredOutline | None]:
        """The outline that each source measures, and its noise."""
        offsets = self.problem.offsets(self.state, self.tracks)
        return [
            outline and MeasuredOutline(outline, offset, track.noise)
            for outline, offset, track in zip(self.outlines, offsets, self.tracks, strict=True)
        ]

    def evidence_at(self, tracks: Sequence[Track]) -> Evidence:
        """The evidence at the noise of other tracks, its residuals relative to the loss."""
        counts = [0 if each is None else int(each.found.sum()) for each in self.outlines]
        pairs = zip(self.tracks, tracks, strict=True)
        ratios = [own.noise.deviation / other.noise.deviation for own, other in pairs]
        evidence, factors = self.with_outlines[0], np.repeat(ratios, counts)
        old = evidence.sightings
        factors = np.append(np.ones(len(old.point) - len(factors)), factors)
        whitening, scale = factors[:, None] * old.whitening, factors * old.loss_scale
        return evidence._replace(sightings=old._replace(whitening=whitening, loss_scale=scale))


def first_fit(problem: OutlineProblem, state: State) -> OutlineFit | None:
    """The estimate that rounds from a start lead to; None without an outline."""
    return _approached(problem, state, [source.first() for source in problem.sources])


def last_fit(fit: OutlineFit) -> OutlineFit | None:
    """The end near another estimate; None without an outline."""
    begun = zip(fit.problem.sources, fit.tracks, strict=True)
    end = _approached(fit.problem, fit.state, [source.last(track) for source, track in begun])
    return None if end is None else _with_wider_noise(end)


def _approached(
    problem: OutlineProblem, state: State, tracks: Sequence[Track]
) -> OutlineFit | None:
    """The last of the rounds, at the last level where noise and objective stay."""
    fit: OutlineFit | None = None
    for _ in range(_MOST_ROUNDS):
        posed = problem.surface.at(problem.evidence.shape, state)
        sights, offsets = problem.sights(state, posed), problem.offsets(state, tracks)
        outlines = [
            source.outline(sight, posed, track)
            for source, sight, track in zip(problem.sources, sights, tracks, strict=True)
        ]
        learned = [
            track if outline is None else source.learned(outline, offset, track)
            for source, outline, offset, track in zip(
                problem.sources, outlines, offsets, tracks, strict=True
            )
        ]
        here = problem.with_outlines(state, posed, sights, outlines, learned)
        if here is None:
            return None
        evidence, before = here
        least, _, after = refine_joint(evidence, _ITERATIONS, before)
        if not least < np.inf:
            return None
        gain = objective_of(evidence, before) - objective_of(evidence, after)
        learned, state = _with_likeliest_offsets(problem, evidence, after, learned)
        fit = OutlineFit(problem, (evidence, after), state, outlines, learned)
        is_settled = gain < _LEAST_GAIN and all(map(Track.is_like, learned, tracks))
        is_settled |= not any(source.learns_sigma for source in problem.sources)
        if is_settled and not any(track.levels for track in tracks):
            break
        tracks = [track.next for track in learned]
    return fit


def _with_likeliest_offsets(
    problem: OutlineProblem, evidence: Evidence, state: State, tracks: Sequence[Track]
) -> tuple[list[Track], State]:
    """Tracks whose offsets have the likeliest deviations, and the bare state in terms of these."""
    still = np.zeros_like(problem.evidence.shape.mean)
    bare = state._replace(coefficients=state.coefficients.copy(), displacements=still)
    learned = list(tracks)
    learning = np.flatnonzero([each.learns_sigma and each.is_exact for each in problem.sources])
    if not len(learning):
        return learned, bare
    own = problem.own_of(bare)
    _, information = information_of(evidence, state)
    rows = len(information) - own.size + OWN_MODES * learning
    variances = _solved(information, np.eye(len(information))[:, rows])[rows].diagonal()
    for number, variance in zip(learning, variances, strict=True):
        noise = learned[number].noise
        offset = likeliest_offset(own[number, 0], variance, noise)
        learned[number] = learned[number]._replace(noise=noise._replace(offset=offset))
        own[number, 0] *= noise.offset / offset
    return learned, bare


def likeliest_offset(own: float, variance: float, noise: Noise) -> float:
    """Likeliest deviation [px] of an offset, by its coefficient and the variance of that."""
    without_prior = 1 / max(1 / min(variance, 1.0) - 1, 1e-6)  # in squares of the offset
    free = own * (1 + without_prior)
    square = noise.offset**2 * max(free**2 - without_prior, 0.0)
    return max(float(np.sqrt(square)), LEAST_OFFSET)


def _with_wider_noise(fit: OutlineFit) -> OutlineFit:
    """The same, its outlines' noise widened by the degrees of freedom that they determine."""
    evidence, state = fit.with_outlines
    rows = np.arange(len(evidence.sightings.point))
    is_outline = rows >= len(fit.problem.evidence.sightings.point)
    (_, whole), (_, rest) = (
        information_of(with_whitening_times(times, is_outline, evidence), state)
        for times in (1.0, 0.0)
    )
    fitted = float(np.trace(_solved(whole, whole - rest)))
    independent = sum(
        float(outline.found.sum()) / track.noise.correlation
        for outline, track in zip(fit.outlines, fit.tracks, strict=True)
        if outline is not None
    )
    factor = np.sqrt(max(1 - fitted / max(independent, 1.0), _LEAST_FREEDOM))
    wider = with_whitening_times(factor, is_outline, evidence)
    return fit._replace(with_outlines=(wider, state))


def _solved(information: FloatArray, right: FloatArray) -> FloatArray:
    """The covariance times columns (U, k), of unknowns of which next to nothing may be known."""
    matrix, sizes = scaled_information(information)
    matrix = matrix + _LEAST_INFORMATION * np.eye(len(sizes))
    return np.asarray(np.linalg.solve(matrix, right / sizes[:, None]) / sizes[:, None])
