"""Third stage of an estimate: refine minima with masks and photos.

The starts are the likely minima of the other evidence and, if the best one is poorly determined,
neighbouring states. Masks and photos that contradict the other evidence are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError
from cadalign.estimation.contours.outline import (
    OutlineSupport,
    Surface,
    Track,
    surface_of,
)
from cadalign.estimation.contours.photo_lines import photo_of
from cadalign.estimation.contours.rounds import (
    OutlineFit,
    Source,
    add_displacement_modes,
    first_fit,
    last_fit,
)
from cadalign.estimation.contours.sources import MaskSource, PhotoSource, convex_hull
from cadalign.estimation.model import is_exact_model
from cadalign.estimation.problem import Problem
from cadalign.estimation.result_parts import EstimateWarning, OutlineNotes
from cadalign.estimation.search import Minimum
from cadalign.estimation.uncertainty.residuals import chi_square_quantile
from cadalign.estimation.view import View
from cadalign.geometry.rotations import angles_between, rotation_from_vector
from cadalign.io.images import ByteImage
from cadalign.solvers.joint.covariance import information_of, scaled_information
from cadalign.solvers.joint.evidence import State
from cadalign.solvers.joint.search import cost_of, reduce_evidence, score_state

_MOST_STARTS = 4
_MOST_OPEN_STARTS = 12  # where only masks determine the estimate
_MOST_FINISHED = 4
_LEAST_EIGENVALUE = 1e-12
_UNLIKELY = 60.0  # excess score of a minimum that is still a start
_LEAST_INFORMATION = 1e-9  # relative, in the least determined direction
# Neighbouring starts: number of least determined directions, steps along these [sigma], and limits
# of the turn and of the log scales at one standard deviation.
_WEAKEST, _SIDEWAYS = 2, (-1.5, 1.5)
_LEAST_TURN, _MOST_TURN, _LEAST_STRETCH = np.radians(1.3), np.radians(40.0), 0.05
_SAME_TURN_DEG, _SAME_STRETCH = 1.0, 0.2  # logarithms of scales
_LEAST_SUPPORT = 0.5  # share of a source's samples that must agree with the outline
_LEAST_PROBABILITY = 1e-5  # that chance raises the other residuals as much
_NO_OUTLINE = (
    "give an init nearer to it, or keypoints, and check that a mask is nonzero on the object, not "
    "around it, and that the model is the object's"
)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A start, its refined estimate, and the noise at which candidates are compared."""

    start: Minimum
    fit: OutlineFit
    tracks: list[Track]

    @cached_property
    def supports(self) -> list[OutlineSupport]:
        return [
            OutlineSupport() if each is None else source.support(each)
            for source, each in self.fit.measured
        ]

    @cached_property
    def rank(self) -> float:
        """-2 log probability from the other evidence and the outlines, up to a constant."""
        rest = cost_of(self.fit.problem.evidence, self.fit.state) + self.start.prior_score
        return rest + sum(source.rank(each) for source, each in self.fit.measured if each)

    @cached_property
    def minimum(self) -> Minimum:
        """The minimum; its score contains the `rank` instead of the cost."""
        evidence, state = self.fit.whole
        cost = cost_of(evidence, state)
        at_common = self.fit.evidence_at(self.tracks)
        score = score_state(at_common, state) - cost_of(at_common, state) + self.rank
        return self.start._replace(evidence=evidence, state=state, cost=cost, score=score)


def refine(problem: Problem, minima: Sequence[Minimum]) -> tuple[list[Minimum], OutlineNotes]:
    """Refine likely minima with masks or, in views without masks, photos; the likeliest first.

    Raises InputError if a mask has no contour or the model no mesh; DegenerateError if only the
    outlines determine the estimate, and no start comes near them.
    """
    model, views, keypoints = problem.model, problem.views, len(problem.prior.ids)
    first, is_exact = minima[0], is_exact_model(model)
    is_open = not _is_determined(first)
    hulls = [] if is_exact else _convex_views(views)
    sources = left = sources_of(hulls or views, first, is_exact=is_exact)
    points, where = first.points[:keypoints], min(source.where for source in sources)
    surface = surface_of(model, points, where, is_hull=bool(hulls))
    likely = [each for each in minima if is_open or each.score < first.score + _UNLIKELY]
    likely = likely[: _MOST_OPEN_STARTS if is_open else _MOST_STARTS]
    warnings: list[EstimateWarning] = []
    best: list[Candidate] = []
    wrong: tuple[Source, str] | None = None
    while left:
        best = _candidates(likely, left, surface, keypoints, is_open=is_open)
        wrong = _contradiction(best, left)
        if wrong is None:
            break
        source, reason = wrong
        if is_open and len(left) == 1:
            if not best or not best[0].supports[0].share:
                raise DegenerateError(reason, where=source.where, fix=_NO_OUTLINE)
            warnings.append(source.warning(f"{source.where}: {reason}"))
            break
        text = f"{source.where} contradicts the rest and is left out: {reason}"
        warnings.append(source.warning(text))
        left = [each for each in left if each is not source]
    supports = dict(zip(left, best[0].supports, strict=True)) if left else {}
    if not wrong:
        doubts = {source: source.doubt(each) for source, each in supports.items()}
        warnings += [source.warning(text) for source, text in doubts.items() if text]
    summaries = [source.summary(supports.get(source, OutlineSupport())) for source in sources]
    found = [each.minimum for each in best] if left else list(minima)
    return found, OutlineNotes(tuple(summaries), tuple(warnings))


def _candidates(
    likely: Sequence[Minimum],
    sources: Sequence[Source],
    surface: Surface,
    keypoints: int,
    *,
    is_open: bool,
) -> list[Candidate]:
    """Distinct candidates near likely minima, the likeliest first."""
    starts = [(each, each.state) for each in likely]
    has_photo = not all(each.learns_sigma for each in sources)
    if not is_open and (surface.is_exact or has_photo):
        starts += _neighbouring_starts(likely[0], is_exact=surface.is_exact)
    near = []
    for start, state in starts:
        fit = first_fit(start.evidence, state, keypoints, sources, surface)
        near += [] if fit is None else [Candidate(start, fit, fit.tracks)]
    near = _distinct_candidates(near)[:_MOST_FINISHED]
    found = []
    for each in near:
        if each.rank < near[0].rank + _UNLIKELY:
            end = last_fit(each.fit)
            found += [] if end is None else [Candidate(each.start, end, end.tracks)]
    found = _distinct_candidates(found)
    alike = [replace(each, tracks=found[0].fit.tracks) for each in found]
    return sorted(alike, key=lambda each: each.minimum.score)


def _convex_views(views: Sequence[View]) -> list[View]:
    """Replace masks by their convex hulls; no views if a mask is missing or leaves the image.

    Similar objects differ more between legs or in holes than in their outermost points, which
    keypoints and box describe. The silhouette of a convex hull is the hull of the silhouette.
    """
    found = []
    for view in views:
        hull = None if view.mask_image is None else convex_hull(view.mask_image)
        if hull is None and view.has_outline:
            return []
        found.append(view if hull is None else replace(view, mask=hull))
    return found


def sources_of(views: Sequence[View], minimum: Minimum, *, is_exact: bool) -> list[Source]:
    found: list[Source] = []
    for image, (view, camera) in enumerate(zip(views, minimum.lenses.cameras, strict=True)):
        if view.mask_image is not None:
            found.append(MaskSource.from_view(image, view, camera, is_exact=is_exact))
        elif view.image is not None:
            photo = photo_of(camera, cast(ByteImage, view.image))
            found.append(PhotoSource(image, view.number, camera, is_exact, photo))
    return found


def _is_determined(minimum: Minimum) -> bool:
    """True if the evidence without outlines determines all unknowns."""
    _, information = information_of(*reduce_evidence(minimum.evidence, minimum.state))
    if not np.isfinite(information.diagonal()).all() or not (information.diagonal() > 0).all():
        return False
    return bool(np.linalg.eigvalsh(scaled_information(information)[0])[0] > _LEAST_INFORMATION)


def _neighbouring_starts(start: Minimum, *, is_exact: bool) -> list[tuple[Minimum, State]]:
    """States beside an estimate, along its least determined directions if these are wide."""
    _, information = information_of(*reduce_evidence(start.evidence, start.state))
    poses, rest = 6 * len(start.state.poses), len(start.state.log_focals) + 3
    count = poses + rest * is_exact
    matrix, sizes = scaled_information(information[:count, :count])
    values, vectors = np.linalg.eigh(matrix)
    roots = np.sqrt(np.maximum(values[:_WEAKEST], _LEAST_EIGENVALUE))
    found = []
    for weak in (vectors[:, :_WEAKEST] / roots / sizes[:, None]).T:
        step = np.append(weak, np.zeros(poses + rest - count))
        turn = np.linalg.norm(step[:poses].reshape(-1, 6)[:, :3], axis=1).max()
        stretch = np.abs(step[-3:]).max()
        if max(turn / _LEAST_TURN, stretch / _LEAST_STRETCH) > 1 and turn < _MOST_TURN:
            found += [(start, _move(start.state, sign * step)) for sign in _SIDEWAYS]
    return found


def _move(state: State, step: FloatArray) -> State:
    """Apply a step (U,) of poses, log focals and log scales to a state."""
    poses, focals = state.poses.copy(), len(state.log_focals)
    turns, by_focal, by_scale = np.split(step, 6 * len(poses) + np.array([0, focals]))
    for pose, part in zip(poses, turns.reshape(-1, 6), strict=True):
        pose[:9] = (rotation_from_vector(part[:3]) @ pose[:9].reshape(3, 3)).ravel()
        pose[9:] += part[3:]
    logs = {"log_focals": state.log_focals + by_focal, "log_scales": state.log_scales + by_scale}
    return state._replace(poses=poses, **logs)


def _distinct_candidates(candidates: list[Candidate]) -> list[Candidate]:
    """Sort candidates by probability, and drop duplicates."""
    kept: list[Candidate] = []
    for each in sorted(candidates, key=lambda candidate: candidate.rank):
        if not any(_are_same(each.fit.state, other.fit.state) for other in kept):
            kept.append(each)
    return kept


def _are_same(one: State, other: State) -> bool:
    turn, other_turn = (each.poses[0, :9].reshape(3, 3) for each in (one, other))
    stretch = np.abs(one.log_scales - other.log_scales).max()
    return bool(angles_between(turn, other_turn) < _SAME_TURN_DEG and stretch < _SAME_STRETCH)


def _contradiction(best: list[Candidate], sources: Sequence[Source]) -> tuple[Source, str] | None:
    supports = best[0].supports if best else [OutlineSupport()]
    worst = min(range(len(supports)), key=lambda number: supports[number].share)
    if supports[worst].share < _LEAST_SUPPORT:
        return sources[worst], sources[worst].refusal(supports[worst])
    reason = _tension(best[0])
    return None if reason is None else (sources[worst], reason)


def _tension(candidate: Candidate) -> str | None:
    """The reason if outlines raise the other residuals by more than chance explains; else None."""
    start, problem, state = candidate.start, candidate.fit.problem, candidate.fit.state
    evidence = start.evidence
    equations = 2 * int((evidence.sightings.whitening[:, 2] > 0).sum())
    if not equations:
        return None
    still = add_displacement_modes(evidence, start.state)
    alone, joint = cost_of(*still), cost_of(problem.evidence, state)
    free = 6 * len(state.poses) + int(evidence.scales.free.sum())
    redundancy = equations - free
    scale = max(1.0, alone / redundancy) if redundancy > 0 else 1.0
    own = problem.own_of(state).size
    unknowns = min(free + len(still[1].coefficients), equations) + own
    if joint - alone <= scale * chi_square_quantile(unknowns, _LEAST_PROBABILITY):
        return None
    times = np.sqrt(joint / max(alone, float(max(redundancy, 1))))
    return f"with it the other residuals are {times:.2g} times as large"
