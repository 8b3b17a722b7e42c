"""Fit a model's outline to masks and photos, together with all other evidence.

Each round measures the outlines at a state, estimates their noise from the residuals, and refines
the state with the rim's points fixed on the surface. A rim moves along the surface as the pose
changes. To first order, this does not change its distance from the contour, and the next round
detects the rim again. The points of the rims are rows of the shape, between the keypoints and the
box's corners. The last modes of the shape are the contours' offsets and registrations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.estimation.contours.contour import Sight
from cadalign.estimation.contours.outline import (
    LEAST_OFFSET,
    REGISTRATION,
    MeasuredOutline,
    Noise,
    Outline,
    PosedSurface,
    Surface,
    Track,
)
from cadalign.estimation.contours.sources import MaskSource, PhotoSource
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.search import scale_whitening
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.covariance import information_of, scaled_information
from cadalign.solvers.joint.evidence import (
    Evidence,
    Shape,
    Sightings,
    State,
    log_focals_of,
    stack_tables,
)
from cadalign.solvers.joint.search import displaced_modes, objective_of, refine_joint

Source = MaskSource | PhotoSource
"""A mask or a photo of a view."""
_OWN_MODES = 3
"""Unknowns of a contour: its offset outwards, and its registration along x and y."""
_MOST_ROUNDS, _MOST_LAST_ROUNDS = 16, 8  # of the first and of the last fit
_ITERATIONS = 4  # of a round: rims change with the state
_LEAST_GAIN = 2.0  # of the objective, -2 log likelihood, in a round
_LEAST_FREEDOM = 0.1  # least share of the residuals' degrees of freedom after the fit
_LEAST_INFORMATION = 1e-12  # relative, in every direction


class OutlineProblem(NamedTuple):
    """Evidence with a number of ``keypoints``, the surface, and the ``sources`` of its outline."""

    evidence: Evidence
    keypoints: int
    sources: Sequence[Source]
    surface: Surface

    def own_of(self, state: State) -> FloatArray:
        """Coefficients (V, 3) of the contours' own modes."""
        count = _OWN_MODES * len(self.sources)
        return state.coefficients[-count:].reshape(-1, _OWN_MODES)

    def offsets(self, state: State, tracks: Sequence[Track]) -> list[float]:
        own = self.own_of(state)[:, 0].tolist()
        return [each * track.noise.offset for each, track in zip(own, tracks, strict=True)]

    def sights(self, state: State, posed: PosedSurface) -> list[Sight]:
        """The posed surface in each source's camera, with its focal length and registration."""
        ratios = np.exp(log_focals_of(self.evidence, state)).tolist()
        poses, found = poses_of(self.evidence, state), []
        for source, own in zip(self.sources, self.own_of(state), strict=True):
            camera, ratio = source.camera, ratios[source.image]
            if ratio != 1.0:
                camera = camera.replace_focal(camera.fx * ratio)
            right, down = (REGISTRATION * own[1:]).tolist()
            camera = replace(camera, cx=camera.cx + right, cy=camera.cy + down)
            found.append(Sight(posed.caster, camera, poses[source.image]))
        return found

    def add_outlines(
        self,
        state: State,
        posed: PosedSurface,
        sights: Sequence[Sight],
        outlines: Sequence[Outline | None],
        tracks: Sequence[Track],
    ) -> tuple[Evidence, State] | None:
        """Add measured outlines to the evidence and the state; None without any."""
        rows = [
            self._rows_of(number, outline, track.noise, posed, sight)
            for number, (outline, track, sight) in enumerate(
                zip(outlines, tracks, sights, strict=True)
            )
            if outline is not None and outline.found.any()
        ]
        if not rows:
            return None
        shape, first = self.evidence.shape, self.keypoints
        means, modes, sightings = zip(*rows, strict=True)
        places = np.full(sum(map(len, means)), first)
        mean = np.insert(shape.mean, places, np.concatenate(means), axis=0)
        moved = np.insert(shape.modes, places, np.concatenate(modes, axis=1), axis=1)
        own = stack_tables(sightings)._replace(point=first + np.arange(len(places)))
        evidence = self._shift_points(len(places))
        evidence = evidence._replace(
            shape=Shape(mean, moved, np.insert(shape.spread, places, 0.0)),
            sightings=stack_tables([evidence.sightings, own]),
        )
        return evidence, state._replace(displacements=np.zeros_like(mean))

    def _shift_points(self, count: int) -> Evidence:
        """The evidence with point indices shifted for ``count`` points of outlines."""

        def moved(points: IntArray) -> IntArray:
            return np.where(points >= self.keypoints, points + count, points)

        given = self.evidence
        sightings, offsets = given.sightings, given.offsets
        whole = given._replace(sightings=sightings._replace(point=moved(sightings.point)))
        return whole.add_block(offsets._replace(ends=moved(offsets.ends)))

    def _rows_of(
        self, number: int, outline: Outline, noise: Noise, surface: PosedSurface, sight: Sight
    ) -> tuple[FloatArray, FloatArray, Sightings]:
        """Mean (n, 3), modes (K, n, 3) and sightings of a source's found samples.

        At the state of the ``sight``, the residuals are the measured distances along the normals.
        """
        source = self.sources[number]
        kept = np.flatnonzero(outline.found)
        points, across, count = outline.points[kept], outline.across[kept], len(kept)
        given, camera = source.camera, sight.camera
        focal, root = np.array([given.fx, given.fy]), np.sqrt(noise.correlation)
        step = across / (across**2).sum(axis=1, keepdims=True)
        seen, ratio = sight.pose.apply(points), camera.fx / given.fx
        rays = ratio * seen[:, :2] / seen[:, 2:]
        rays += np.subtract((camera.cx, camera.cy), (given.cx, given.cy)) / focal
        rays += outline.places[kept, None] * step
        moved = np.zeros((_OWN_MODES, count, 3))
        moved[0, :, :2] = noise.offset * step
        for axis in range(2):
            moved[1 + axis, :, axis] = REGISTRATION / focal[axis]
        moved *= seen[:, 2:] / ratio
        mean, modes = surface.rows(points, outline.face[kept])
        every = np.zeros((len(self.evidence.shape.modes), count, 3))
        every[: len(modes)] = modes  # none for a rigid surface
        own = len(every) - _OWN_MODES * (len(self.sources) - number)
        every[own : own + _OWN_MODES] = moved @ sight.pose.rotation / sight.pose.scale
        weights = 1 / (noise.sigma * outline.sigmas[kept] * root)
        sightings = Sightings(
            np.arange(count),
            np.full(count, source.image),
            rays,
            np.column_stack([across * weights[:, None], np.zeros(count)]),
            np.zeros((count, 3)),
            np.full(count, CAUCHY),
            np.full(count, noise.loss_scale / root),
        )
        return mean, every, sightings


def add_displacement_modes(evidence: Evidence, state: State) -> tuple[Evidence, State]:
    """Convert the points' independent displacements to modes, which a warped surface follows."""
    shape, rows = evidence.shape, np.flatnonzero(evidence.shape.spread > 0)
    modes = displaced_modes(shape, rows)
    moved = state.displacements[rows] / shape.spread[rows, None]
    return (
        evidence._replace(shape=Shape(shape.mean, modes, np.zeros_like(shape.spread))),
        state._replace(
            coefficients=np.concatenate([state.coefficients, moved.ravel()]),
            displacements=np.zeros_like(state.displacements),
        ),
    )


class OutlineFit(NamedTuple):
    """An estimate, and the ``outlines`` of its last round.

    ``whole`` is the evidence and the state with the outlines' points, ``state`` is without these.
    """

    problem: OutlineProblem
    whole: tuple[Evidence, State]
    state: State
    outlines: list[Outline | None]
    tracks: list[Track]

    @property
    def measured(self) -> list[tuple[Source, MeasuredOutline | None]]:
        """Each source with its measured outline."""
        sources, offsets = self.problem.sources, self.problem.offsets(self.state, self.tracks)
        return [
            (source, outline and MeasuredOutline(outline, offset, track.noise))
            for source, outline, offset, track in zip(
                sources, self.outlines, offsets, self.tracks, strict=True
            )
        ]

    def evidence_at(self, tracks: Sequence[Track]) -> Evidence:
        """The evidence with the noise of other tracks; the loss scales likewise."""
        counts = [0 if each is None else int(each.found.sum()) for each in self.outlines]
        pairs = zip(self.tracks, tracks, strict=True)
        ratios = [own.noise.deviation / other.noise.deviation for own, other in pairs]
        evidence, factors = self.whole[0], np.repeat(ratios, counts)
        old = evidence.sightings
        factors = np.append(np.ones(len(old.point) - len(factors)), factors)
        whitening, scale = factors[:, None] * old.whitening, factors * old.loss_scale
        return evidence._replace(sightings=old._replace(whitening=whitening, loss_scale=scale))


def first_fit(
    evidence: Evidence, state: State, keypoints: int, sources: Sequence[Source], surface: Surface
) -> OutlineFit | None:
    """Run the first rounds from evidence and a state without outlines; None without an outline."""
    evidence, state = add_displacement_modes(evidence, state)
    shape, own = evidence.shape, np.zeros(_OWN_MODES * len(sources))
    modes = np.concatenate([shape.modes, np.zeros((len(own), *shape.mean.shape))])
    with_own = evidence._replace(shape=shape._replace(modes=modes))
    start = state._replace(coefficients=np.append(state.coefficients, own))
    problem = OutlineProblem(with_own, keypoints, sources, surface)
    return _run_rounds(problem, start, [source.first() for source in sources], _MOST_ROUNDS)


def last_fit(fit: OutlineFit) -> OutlineFit | None:
    """Run the last rounds from an estimate; None without an outline."""
    begun = zip(fit.problem.sources, fit.tracks, strict=True)
    tracks = [source.last(track) for source, track in begun]
    end = _run_rounds(fit.problem, fit.state, tracks, _MOST_LAST_ROUNDS)
    return None if end is None else _widen_noise(end)


def _run_rounds(
    problem: OutlineProblem, state: State, tracks: Sequence[Track], rounds: int
) -> OutlineFit | None:
    """Run rounds until, at the last level, noise and objective converge; at most ``rounds``."""
    fit: OutlineFit | None = None
    for _ in range(rounds):
        posed = problem.surface.pose(problem.evidence.shape, state)
        sights, offsets = problem.sights(state, posed), problem.offsets(state, tracks)
        outlines = [
            source.outline(sight, track)
            for source, sight, track in zip(problem.sources, sights, tracks, strict=True)
        ]
        learned = [
            track if outline is None else source.learn(outline, offset, track)
            for source, outline, offset, track in zip(
                problem.sources, outlines, offsets, tracks, strict=True
            )
        ]
        here = problem.add_outlines(state, posed, sights, outlines, learned)
        if here is None:
            return None
        evidence, before = here
        least, _, after = refine_joint(evidence, _ITERATIONS, before)
        if not least < np.inf:
            return None
        gain = objective_of(evidence, before) - objective_of(evidence, after)
        learned, state = _update_offsets(problem, evidence, after, learned)
        fit = OutlineFit(problem, (evidence, after), state, outlines, learned)
        is_settled = gain < _LEAST_GAIN and all(map(Track.is_like, learned, tracks))
        is_settled |= not any(source.learns_sigma for source in problem.sources)
        if is_settled and not any(track.levels for track in tracks):
            break
        tracks = [track.next for track in learned]
    return fit


def _update_offsets(
    problem: OutlineProblem, evidence: Evidence, state: State, tracks: Sequence[Track]
) -> tuple[list[Track], State]:
    """Tracks with the likeliest deviations of offsets, and the bare state rescaled to these."""
    still = np.zeros_like(problem.evidence.shape.mean)
    bare = state._replace(coefficients=state.coefficients.copy(), displacements=still)
    learned = list(tracks)
    learning = np.flatnonzero([each.learns_sigma and each.is_exact for each in problem.sources])
    if not len(learning):
        return learned, bare
    own = problem.own_of(bare)
    _, information = information_of(evidence, state)
    rows = len(information) - own.size + _OWN_MODES * learning
    variances = _solve_information(information, np.eye(len(information))[:, rows])[rows].diagonal()
    for number, variance in zip(learning, variances, strict=True):
        noise = learned[number].noise
        offset = likeliest_offset(own[number, 0], variance, noise)
        learned[number] = learned[number]._replace(noise=noise._replace(offset=offset))
        own[number, 0] *= noise.offset / offset
    return learned, bare


def likeliest_offset(own: float, variance: float, noise: Noise) -> float:
    """Likeliest deviation [px] of an offset with a coefficient ``own`` and its variance."""
    without_prior = 1 / max(1 / min(variance, 1.0) - 1, 1e-6)  # in squares of the offset
    free = own * (1 + without_prior)
    square = noise.offset**2 * max(free**2 - without_prior, 0.0)
    return max(float(np.sqrt(square)), LEAST_OFFSET)


def _widen_noise(fit: OutlineFit) -> OutlineFit:
    """Widen the outlines' noise for the degrees of freedom that the outlines determine."""
    evidence, state = fit.whole
    rows = np.arange(len(evidence.sightings.point))
    is_outline = rows >= len(fit.problem.evidence.sightings.point)
    (_, whole), (_, rest) = (
        information_of(scale_whitening(times, is_outline, evidence), state) for times in (1.0, 0.0)
    )
    fitted = float(np.trace(_solve_information(whole, whole - rest)))
    independent = sum(
        float(outline.found.sum()) / track.noise.correlation
        for outline, track in zip(fit.outlines, fit.tracks, strict=True)
        if outline is not None
    )
    factor = np.sqrt(max(1 - fitted / max(independent, 1.0), _LEAST_FREEDOM))
    wider = scale_whitening(factor, is_outline, evidence)
    return fit._replace(whole=(wider, state))


def _solve_information(information: FloatArray, right: FloatArray) -> FloatArray:
    """Multiply the regularised covariance by columns (U, k)."""
    matrix, sizes = scaled_information(information)
    matrix = matrix + _LEAST_INFORMATION * np.eye(len(sizes))
    return np.asarray(np.linalg.solve(matrix, right / sizes[:, None]) / sizes[:, None])
