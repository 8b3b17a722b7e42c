"""Live alignment of what is marked, as the page draws it, and the keypoint to mark next."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cadalign.annotate.marks import KeypointRegistry, ObjectShape, positions_of
from cadalign.annotate.model import Wireframe
from cadalign.annotate.observations import LEAST_JOINT_PAIRS
from cadalign.annotate.problem import LiveEstimate
from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.estimation.result import Result
from cadalign.geometry.camera import projection_jacobian
from cadalign.io.observation import Observation
from cadalign.render.viewpoints import visible_keypoints

_LEAST_PAIRS = 4  # of an alignment without evidence beside them
# Depth of visible points beneath the surface, and beneath one that is warped [diagonals].
_BENEATH, _BENEATH_WARPED = 2e-3, 0.02


@dataclass(frozen=True)
class Suggestion:
    """A keypoint of the model whose place in the photo would tell most."""

    point: ModelKeypoint
    uv: tuple[float, float]  # its predicted place in the photo [px]
    sigma: float  # standard deviation of that place [px]

    @property
    def text(self) -> str:
        """Name of the point, and what is known of it."""
        return f"{self.point.name}, so far known to ± {short(self.sigma)} px"


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """Alignment of what is marked so far; without one a message says why."""

    estimate: LiveEstimate | None = None
    message: str = ""
    counts: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    """(n,), the complete pairs that count."""
    residuals: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    """(n, 2), projected minus placed points of all complete pairs [px]."""
    outliers: Mapping[int, float] = field(default_factory=dict)
    """Distances [px] of the pairs that contradict the others, by their rows."""
    wireframe: Wireframe | None = None
    """Lines of the model, warped to an own shape, in its frame before the stretch."""
    suggestion: Suggestion | None = None

    @property
    def result(self) -> Result | None:
        """The result of the estimate."""
        return None if self.estimate is None else self.estimate.result


def live_alignment(
    estimate: LiveEstimate,
    shape: ObjectShape,
    registry: KeypointRegistry,
    wireframe: Wireframe,
    pairs: tuple[Sequence[ModelKeypoint], FloatArray, BoolArray],
    used: Collection[int],
) -> LiveAlignment:
    """An estimate as the page shows it.

    The ``pairs`` are the model points and photo points (n, 2) [px] of all complete ones, and which
    of them count; ``used`` are the keypoints of all pairs, and the wireframe is the model's.
    """
    result, (points, uv, counts) = estimate.result, pairs
    lines, carried = wireframe, positions_of(points)[~counts]
    if shape.is_estimated:  # warped such that known keypoints come to the estimated ones
        own: dict[Hashable, ModelKeypoint] = {shape.id_of(point): point for _, point in registry}
        rows = [row for row, label in enumerate(result.ids) if label in own]
        source = positions_of(own[result.ids[row]] for row in rows)
        target = result.points_3d[rows]
        lines, carried = wireframe.warped(source, target, result.bounds, carried=carried)
    residuals = np.empty((len(points), 2))
    residuals[counts] = result.residuals
    placed = result.alignment.apply(carried)
    residuals[~counts] = result.camera.project_where_ahead(placed) - uv[~counts]
    rows = np.flatnonzero(counts).tolist()
    outliers = {rows[row]: off for row, off in estimate.outliers.items()}
    free = [point for number, point in registry if number not in used]
    suggestion = suggest(estimate, lines, free, shape)
    return LiveAlignment(estimate, "", counts, residuals, outliers, lines, suggestion)


def missing_text(counts: BoolArray, shape: ObjectShape, observation: Observation) -> str:
    """Say how many more pairs the first alignment needs; empty if none.

    ``counts`` (n,) are the complete pairs that count.
    """
    if not shape.is_estimated and (observation.evidence.mask or observation.init):
        return ""
    is_plain = observation.is_plain and not shape.is_estimated
    missing = (_LEAST_PAIRS if is_plain else LEAST_JOINT_PAIRS) - int(counts.sum())
    if missing <= 0:
        return ""
    text = f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
    if not counts.all() and shape.learned is not None:
        text += f": keypoints that {shape.learned.category} has, the white points on the model"
    return text


def suggest(
    estimate: LiveEstimate, lines: Wireframe, points: Sequence[ModelKeypoint], shape: ObjectShape
) -> Suggestion | None:
    """Choose the visible one of some keypoints that tells most.

    A click of the standard deviation s tells log det(1 + C / s^2) / 2 of the estimate, where C is
    the covariance of the point's predicted place.
    """
    result = estimate.result
    camera, pose, is_warped = result.camera, result.alignment, shape.is_estimated
    if result.covariance is None or ("x" in result.stretched_axes and not is_warped):
        return None
    rows = {label: row for row, label in enumerate(result.ids)}
    if is_warped:
        points = [point for point in points if shape.id_of(point) in rows]
        own = [rows[shape.id_of(point)] for point in points]
        xyz = result.points_3d[own]
    else:
        xyz = positions_of(points)
    beneath = _BENEATH_WARPED if is_warped else _BENEATH
    seen = np.flatnonzero(visible_keypoints(lines.scene, xyz, camera, pose, tolerance=beneath))
    if not len(seen):
        return None
    if is_warped:
        of_points = result.points_cam_covariance
        assert of_points is not None
        places = camera.projected_covariances(pose.apply(xyz[seen]), of_points[own][seen])
    else:
        slopes = projection_jacobian(xyz[seen], camera, pose)[:, :, : len(result.covariance)]
        places = slopes @ result.covariance @ slopes.transpose(0, 2, 1)
    # Rounded, so that points that differ by rounding alone are chosen by their order.
    gain = np.round(np.linalg.slogdet(np.eye(2) + places / estimate.sigma**2)[1], 9)
    best = int(np.argmax(gain))
    ((u, v),) = camera.project(pose.apply(xyz[seen[best], None])).tolist()
    return Suggestion(points[seen[best]], (u, v), float(np.sqrt(np.trace(places[best]))))


def short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
