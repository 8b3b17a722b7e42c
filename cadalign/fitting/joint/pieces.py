"""Pieces of evidence: what one argument tells, and the evidence without it."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np

from cadalign.arrays import BoolArray, IntArray
from cadalign.solvers.joint.evidence import Evidence, Planes, Rig, Sightings, State

Rows = TypeVar("Rows", bound=tuple[Any, ...])


class Piece(NamedTuple):
    """A kind of evidence (see `cadalign.EvidenceSummary`) and its view."""

    kind: str
    view: int | None


def pieces_of(evidence: Evidence) -> list[Piece]:
    """All pieces, view by view."""
    pieces: list[Piece] = []
    poses = np.bincount(evidence.rig.pose)
    for view, pose in enumerate(evidence.rig.pose.tolist()):
        told = {
            "keypoints": keypoints_in(evidence, view),
            "mask": contours_in(evidence, view),
            "depth": np.append(depths_in(evidence, view), evidence.planes.image == view),
            "gravity": evidence.directions.image == view,
            "camera height": evidence.heights.image == view,
            "rig": np.array([poses[pose] > 1]),
        }
        pieces.extend(Piece(kind, view) for kind, rows in told.items() if rows.any())
    if len(evidence.lengths.value):
        pieces.append(Piece("size", None))
    return pieces


def keypoints_in(evidence: Evidence, view: int) -> BoolArray:
    """Sightings (N,) of a view that tell both coordinates of a ray."""
    sightings = evidence.sightings
    return np.asarray((sightings.image == view) & (sightings.whitening[:, 2] > 0))


def contours_in(evidence: Evidence, view: int) -> BoolArray:
    """Sightings (N,) of a view that tell a ray along a contour's normal alone."""
    sightings = evidence.sightings
    is_contour = (sightings.whitening[:, 2] == 0) & sightings.whitening[:, :2].any(axis=1)
    return np.asarray((sightings.image == view) & is_contour)


def depths_in(evidence: Evidence, view: int) -> BoolArray:
    """Sightings (N,) of a view that tell a depth."""
    sightings = evidence.sightings
    return np.asarray((sightings.image == view) & (sightings.depths[:, 1] > 0))


def without(evidence: Evidence, state: State, piece: Piece) -> tuple[Evidence, State]:
    """The evidence without a piece, and a state of its unknowns.

    Without the known motion of its camera, a view has a pose of its own.
    """
    view = piece.view
    if view is None:
        none = np.zeros(len(evidence.lengths.value), dtype=bool)
        return evidence._replace(lengths=kept_rows(evidence.lengths, none)), state
    if piece.kind == "rig":
        return _unlinked(evidence, state, view)
    if piece.kind == "keypoints":
        return evidence._replace(sightings=_unseen(evidence, view)), state
    if piece.kind == "mask":
        kept = ~contours_in(evidence, view)
        return evidence._replace(sightings=kept_rows(evidence.sightings, kept)), state
    if piece.kind == "depth":
        return _without_depth(evidence, view), state
    if piece.kind == "gravity":
        rest = kept_rows(evidence.directions, evidence.directions.image != view)
        return evidence._replace(directions=rest), state
    rest_of_heights = kept_rows(evidence.heights, evidence.heights.image != view)
    return evidence._replace(heights=rest_of_heights), state


def kept_rows(rows: Rows, kept: BoolArray) -> Rows:
    """Some rows of a table of columns."""
    columns: list[Any] = [np.ascontiguousarray(column[kept]) for column in rows]
    return type(rows)(*columns)


def _unseen(evidence: Evidence, view: int) -> Sightings:
    """The sightings without a view's keypoints, whose depths stay."""
    hidden = keypoints_in(evidence, view)
    kept = ~hidden | depths_in(evidence, view)
    whitening = np.where(hidden[:, None], 0.0, evidence.sightings.whitening)
    return kept_rows(evidence.sightings._replace(whitening=whitening), kept)


def _without_depth(evidence: Evidence, view: int) -> Evidence:
    there = depths_in(evidence, view)
    depths = np.where(there[:, None], 0.0, evidence.sightings.depths)
    planes: Planes = kept_rows(evidence.planes, evidence.planes.image != view)
    sightings = evidence.sightings._replace(depths=depths)
    kept = ~there | sightings.whitening.any(axis=1)
    return evidence._replace(sightings=kept_rows(sightings, kept), planes=planes)


def _unlinked(evidence: Evidence, state: State, view: int) -> tuple[Evidence, State]:
    pose: IntArray = evidence.rig.pose.copy()
    own = state.poses[pose[view]]
    pose[view] = len(state.poses)
    rig = Rig(evidence.rig.cam_from_rig, pose)
    return evidence._replace(rig=rig), state._replace(poses=np.vstack([state.poses, own]))
