"""Warnings about a joint estimate, above all about evidence that contradicts the rest.

Pieces that contradict the others are found by leaving each out.

Without a piece the cost at the optimum falls by the square of what the others predict of it wrong,
whitened by the covariance of the prediction and of the piece together: a chi-square of as many
degrees as the piece has redundant equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cadalign.arrays import IntArray
from cadalign.estimation.result_parts import listed, name_of
from cadalign.estimation.starts import starts_of
from cadalign.estimation.uncertainty.evidence import (
    Piece,
    count_equations,
    depths_of,
    distances_beside,
    image_of,
    pieces_of,
    redundancy_of,
    told_by,
)
from cadalign.estimation.uncertainty.residuals import chi_square_quantile, chi_square_tail
from cadalign.estimation.uncertainty.shape_posterior import ShapeTails, misfits
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.solvers.joint.covariance import information_of, scaled_information
from cadalign.solvers.joint.evidence import Evidence, State, kept_rows, seen_in_cameras
from cadalign.solvers.joint.search import cost_of, reduced, refine_joint, search_joint

_FALSE_ALARMS = 0.005  # of all tests of an estimate together
_REFITTING = 12  # iterations that show if a piece contradicts the others
_LEAST_INFORMATION = 1e-11  # about an unknown, in one that only it is unknown of
_HIDDEN = 6.0  # [sigma], of a depth from most others of its image
_WRONG_UNIT = 100.0  # factor between measured and expected depths
_UNIT = "in another unit (millimetres for metres)?"
_PER_EQUATION = 3.0  # cost that an equation must save for its piece to be blamed
_MOST_TESTED = 40  # pieces
_ALONG = 0.985  # cosine, 10 degrees, between an axis and a direction that may be its own
_AS_LIKELY = 8.0  # difference of the costs saved by explanations that are both named


class _Trial(NamedTuple):
    """The estimate without a piece: the cost that it saves, for so many equations."""

    piece: Piece
    saved: float
    equations: int
    misfit: float  # reduced chi-square of the rest, at least 1
    state: State


def warnings_of(evidence: Evidence, state: State, cost: float, tails: ShapeTails) -> Warnings:
    """Warnings about evidence that contradicts the rest, and residuals beyond their sigma.

    ``state`` is the estimate, ``cost`` its cost; ``tails`` are those of the shape's prior.
    """
    trials = _contradictions(evidence, state, cost)
    found = list(_wrong_units(evidence, state, [trial.piece for trial in trials]))
    if trials:
        best, views = trials[0], {trial.piece.view for trial in trials}
        named = listed([name_of(*trial.piece) for trial in trials])
        sigmas = np.sqrt(best.saved / best.misfit / best.equations)
        hint = next(filter(None, (_hint(evidence, trial) for trial in trials)), "")
        text = f"{named} contradicts the other evidence, by {sigmas:.2g} sigma{hint}"
        view = views.pop() if len(views) == 1 else None
        return (*found, EstimateWarning("contradiction", text, view))
    if not evidence.sightings.loss.any() and not evidence.sightings.depths[:, 2].any():
        found.extend(misfits(cost, redundancy_of(evidence), tails))
    return tuple(found)


def _contradictions(evidence: Evidence, state: State, cost: float) -> Sequence[_Trial]:
    """Trials of the pieces of which one contradicts the rest, the likeliest first."""
    every = pieces_of(evidence)
    pieces = [each for each in every if not _determines_its_pose(evidence, each)]
    if len(every) < 2 or not pieces:
        return ()
    evidence, state = reduced(evidence, state)
    if evidence.sightings.depths[:, 2].any():
        evidence = _without_hidden(evidence, state)
        cost, _, state = refine_joint(evidence, 10 * _REFITTING, state)
    if len(pieces) > _MOST_TESTED:  # those of the largest own cost
        rests = [cost_of(*_without(evidence, state, piece)) for piece in pieces]
        pieces = [pieces[k] for k in np.sort(np.argsort(rests, kind="stable")[:_MOST_TESTED])]
    whole, level = _determined(evidence, state), _FALSE_ALARMS / len(every)

    def suspects(*, searches: bool) -> Iterator[_Trial]:
        """Trials whose piece saves more than one that agrees with the rest."""
        for piece in pieces:
            rest, start = _without(evidence, state, piece)
            lower, refitted = _refitted(rest, start, searches=searches)
            if cost - lower < chi_square_quantile(1, level):  # of one equation; of more, more
                continue
            redundancy, rank = _determined(rest, refitted)
            equations = whole[0] - redundancy
            is_open = piece.kind != "rig" and rank < whole[1]
            if equations <= 0 or is_open or not lower < np.inf:
                continue
            misfit = max(lower / redundancy, 1.0) if redundancy > 0 else 1.0
            if chi_square_tail((cost - lower) / misfit, equations) < level:
                yield _Trial(piece, cost - lower, equations, misfit, refitted)

    if next(suspects(searches=False), None) is None:
        return ()
    found = list(suspects(searches=True))
    noise = min((trial.misfit for trial in found), default=1.0)
    found.sort(key=lambda trial: _PER_EQUATION * trial.equations - trial.saved / noise)

    def is_likely(trial: _Trial) -> bool:
        """True if it explains the misfit as well as the best."""
        fewer = max(found[0].equations - trial.equations, 0)
        return (found[0].saved - trial.saved) / noise < _AS_LIKELY + _PER_EQUATION * fewer

    likely = [each for each in found if is_likely(each)]
    # Without its known motion, a view leaves its keypoints as free as without these.
    freed = [Piece("keypoints", each.piece.view) for each in likely if each.piece.kind == "rig"]
    return [each for each in likely if each is found[0] or each.piece not in freed]


def _determines_its_pose(evidence: Evidence, piece: Piece) -> bool:
    """True for keypoints without which the pose of their view would be open: they test nothing."""
    if piece.kind != "keypoints" or piece.view is None:
        return False
    rig, sightings = evidence.rig, evidence.sightings
    told = told_by(sightings)
    others = (sightings.image == piece.view) & (~told["keypoints"] | (sightings.depths[:, 2] > 0))
    return (rig.pose == rig.pose[piece.view]).sum() == 1 and not others.any()


def _without_hidden(evidence: Evidence, state: State) -> Evidence:
    """The evidence without depths that differ from most of their image: of something else."""
    sightings = evidence.sightings
    depths = sightings.depths.copy()
    for view in np.unique(sightings.image[depths[:, 2] > 0]):
        rows = (sightings.image == view) & (depths[:, 1] > 0)
        expected, measured, weights = depths_of(evidence, state, view)
        factor = np.median(measured / expected)
        is_other = np.abs(measured / factor - expected) * weights >= _HIDDEN
        depths[rows] = np.where(is_other[:, None], 0.0, depths[rows])
    return evidence._replace(sightings=sightings._replace(depths=depths))


def _refitted(rest: Evidence, start: State, *, searches: bool) -> tuple[float, State]:
    """Cost and state of the estimate without a piece, which may lie far from that with it."""
    cost, _, state = refine_joint(rest, (10 if searches else 1) * _REFITTING, start)
    starts = starts_of(rest) if searches else None
    if starts is not None and len(starts.poses):
        minima = search_joint(rest, *starts)[0]
        best = min(range(len(minima.states)), key=lambda k: minima.costs[k], default=None)
        if best is not None and minima.costs[best] < cost:
            return float(minima.costs[best]), minima.states[best]
    return cost, state


def _determined(evidence: Evidence, state: State) -> tuple[int, int]:
    """Equations beyond the unknowns that they determine, and the number of these."""
    _, information = information_of(*reduced(evidence, state))
    rank = 0
    if np.isfinite(information).all():
        values = np.linalg.eigvalsh(scaled_information(information)[0])
        rank = int((values > _LEAST_INFORMATION * len(values)).sum())
    held = int(3 - evidence.scales.free.sum())
    return count_equations(evidence) - (rank - held), rank


# Hints -------------------------------------------------------------------------------------------


def _hint(evidence: Evidence, trial: _Trial) -> str:
    """A hint at another unit of measurements, or at another axis or sign; else nothing."""
    factor = _measured_factor(evidence, trial.state, trial.piece)
    if factor is not None and not _is_plausible(factor):
        return f": {name_of(*trial.piece)} is {factor:.3g} times what is expected, {_UNIT}"
    if trial.piece.kind != "gravity":
        return ""
    given = kept_rows(evidence.directions, evidence.directions.image == trial.piece.view)
    axes = np.vstack([np.zeros(3), np.eye(3)])
    seen = seen_in_cameras(evidence, trial.state.poses, axes, np.repeat(given.image[:1], 4))
    cosines = (seen[1:] - seen[0]) @ given.camera[0]
    if cosines @ given.model[0] < -_ALONG:
        return ": it seems to point down, give its opposite"
    axis = int(np.argmax(np.abs(cosines)))
    if given.model[0, axis] or abs(cosines[axis]) < _ALONG:
        return ""
    name, way = "xyz"[axis], "up" if cosines[axis] > 0 else "down"
    return f": the model's {name} axis points {way} there, is it the up axis (up_axis={name!r})?"


def _wrong_units(
    evidence: Evidence, state: State, blamed: Sequence[Piece]
) -> Iterator[EstimateWarning]:
    """Warnings about measurements in another unit than the model and the rest of the evidence.

    Pieces that are ``blamed`` for a contradiction are left out.
    The estimate may follow them, which then makes the object too large, or leave them out.
    """
    size = float(np.exp(state.log_scales.mean()))
    factors = [(p, _measured_factor(evidence, state, p)) for p in pieces_of(evidence)]
    measured = [(piece, factor) for piece, factor in factors if factor is not None]
    is_rig = bool(evidence.rig.is_shared.any())
    is_alone = len({piece.kind for piece, _ in measured}) == 1 and not is_rig
    is_told = not _is_plausible(size) and (blamed or is_alone)
    for piece, factor in measured:
        if piece in blamed:
            continue
        if not _is_plausible(factor):
            text = f"the measurement is {factor:.2g} times what is expected, {_UNIT}"
        elif is_told:
            text = f"the object is {size:.2g} times as large as the model, is it {_UNIT}"
        else:
            continue
        yield EstimateWarning("unit", f"{name_of(*piece)}: {text}", piece.view)


def _is_plausible(factor: float) -> bool:
    return 1 / _WRONG_UNIT < factor < _WRONG_UNIT


def _without(evidence: Evidence, state: State, piece: Piece) -> tuple[Evidence, State]:
    """The evidence without a piece, and a state of its unknowns.

    Without the known motion of its camera, a view has a pose of its own.
    """
    kind, view, sightings = piece.kind, piece.view, evidence.sightings
    if view is None or kind in ("gravity", "camera height"):
        block = evidence.directions if kind == "gravity" else evidence.offsets
        return evidence.with_block(kept_rows(block, block.image != image_of(piece))), state
    if kind == "rig":
        pose: IntArray = evidence.rig.pose.copy()
        own = state.poses[pose[view]]
        pose[view] = len(state.poses)
        rig = evidence.rig._replace(pose=pose)
        return evidence._replace(rig=rig), state._replace(poses=np.vstack([state.poses, own]))
    hidden = told_by(sightings)[kind] & (sightings.image == view)
    if kind == "depth":
        sightings = sightings._replace(depths=np.where(hidden[:, None], 0.0, sightings.depths))
    else:
        whitening = np.where(hidden[:, None], 0.0, sightings.whitening)
        sightings = sightings._replace(whitening=whitening)
    kept = ~hidden | np.any(list(told_by(sightings).values()), axis=0)
    return evidence._replace(sightings=kept_rows(sightings, kept)), state


def _measured_factor(evidence: Evidence, state: State, piece: Piece) -> float | None:
    """Median of a piece's measured over expected depths or distances; None where it has none."""
    if piece.kind == "depth" and piece.view is not None:
        expected, measured, _ = depths_of(evidence, state, piece.view)
    elif piece.view is None or piece.kind == "camera height":
        expected, measured, _ = distances_beside(evidence, state, piece)
    else:
        return None
    return float(np.median(measured / expected)) if len(measured) else None
