"""Depths at keypoints that the model's own surface covers: a depth image shows that surface."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.estimation.contours.surface import Surface, surfaces_of
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.joint_robust import LEAST_SEEN, cost_of_hidden, hidden_limits
from cadalign.estimation.model import Model
from cadalign.estimation.search import JointProblem, Minimum
from cadalign.estimation.uncertainty.evidence import seen_in_cameras
from cadalign.geometry.alignment import model_rays
from cadalign.solvers.joint.evidence import Evidence, ImageDepths, State, kept_rows, points_of
from cadalign.solvers.joint.search import refine_joint, score_state

_ROUNDS = 6
_ITERATIONS = 12
_UNLIKELY = 60.0  # excess score of a minimum that is still tried
_MOST_COVERED = 12
_COVERED = 0.5  # [sigma], of a keypoint behind the surface


def without_covered(model: Model, problem: JointProblem, minima: list[Minimum]) -> list[Minimum]:
    """Minima by the depths of keypoints that the model's own surface does not hide, the best first.

    A depth image shows that surface in their place. Where next to none is in view, as of keypoints
    inside of the mesh, minima stay as they are.
    """
    first = minima[0]
    keypoints = len(problem.prior.ids)
    surface = surfaces_of(model, first.points[:keypoints], "views[0].depth").surfaces[0]
    likely = [each for each in minima if not each.score > first.score + _UNLIKELY]
    found: dict[tuple[bytes, float], Minimum] = {}
    for each in likely[:_MOST_COVERED]:
        whole = problem.evidence(each.evidence.shape, each.lenses).image_depths
        uncovered = _uncovered(each, whole, surface)
        depths = uncovered.evidence.image_depths
        found.setdefault((depths.point.tobytes(), round(uncovered.score, 3)), uncovered)
    return sorted(found.values(), key=lambda minimum: minimum.score)


def _uncovered(minimum: Minimum, whole: ImageDepths, surface: Surface) -> Minimum:
    """The minimum by those of the ``whole`` depths that the surface does not hide.

    Where another object hides a keypoint, the depths' robust loss allows for it.
    """
    own = minimum.evidence.image_depths
    evidence, state = minimum.evidence._replace(image_depths=whole), minimum.state
    had = set(zip(own.image.tolist(), own.point.tolist(), strict=True))
    rows = zip(whole.image.tolist(), whole.point.tolist(), strict=True)
    shown = np.array([row in had for row in rows])
    # What the score has beside its evidence and the depths that were left out, of keypoints.
    beside = minimum.prior_score - cost_of_hidden(hidden_limits(evidence, state)[0], shown)
    shown = np.zeros(len(whole.point), dtype=bool)
    for _ in range(_ROUNDS):
        again = ~_is_covered(evidence, state, surface)
        if again.sum() < LEAST_SEEN or (again == shown).all():
            break
        shown = again
        some = evidence._replace(image_depths=kept_rows(whole, shown))
        cost, moved, _, _ = refine_joint(some, _ITERATIONS, state)
        score = beside + score_state(some, moved)
        if not np.isfinite(score):
            break
        state = moved
        minimum = minimum._replace(evidence=some, state=state, cost=cost, score=score)
    return minimum


def _is_covered(evidence: Evidence, state: State, surface: Surface) -> BoolArray:
    """Marks the depths (m,) of keypoints that lie behind the surface."""
    depths, posed = evidence.image_depths, surface.at(evidence.shape, state)
    points = points_of(evidence.shape, state)[depths.point]
    seen = seen_in_cameras(evidence, state, points, depths.image)
    covered = np.zeros(len(points), dtype=bool)
    for number, pose in enumerate(poses_of(evidence, state)):
        rows = np.flatnonzero(depths.image == number)
        if not len(rows):
            continue
        origin, model_from_ray = model_rays(pose)
        rays = seen[rows] / seen[rows, 2:]
        face, depth = posed.caster.first_hits(origin, rays @ model_from_ray.T)
        nearer = (seen[rows, 2] - depth) * depths.weight[rows]
        covered[rows] = (face >= 0) & (nearer > _COVERED)
    return covered
