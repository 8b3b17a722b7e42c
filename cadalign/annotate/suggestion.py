"""Suggestion of the next keypoint to mark: the one that reduces the uncertainty most."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.shape_alignment import LiveShape
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.estimation.uncertainty.prediction import predicted_covariances, projection_jacobian
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.projection import projected_covariances
from cadalign.render.views.visibility import visible_keypoints

_BENEATH = 0.02  # depth of visible keypoints beneath the warped surface [diagonals]
_APART = 0.02  # least distance of a corner from marked points [diagonals]


@dataclass(frozen=True)
class NextBest:
    """The candidate to measure next, and its effect on the most uncertain unknown.

    The standard deviations are in radians, shares of the distance, or relative (0.02 is 2 %).
    """

    row: int
    unknown: int  # its index in `Result.covariance`
    before: float  # standard deviation without the measurement
    after: float


@dataclass(frozen=True)
class Unmarked:
    """A keypoint that is not marked, and the standard deviation of its place in the photo [px]."""

    deviation: float


@dataclass(frozen=True, eq=False)
class UncertainPose:
    """An estimate as far as a suggestion follows from it, its covariance as of `Result`."""

    camera: Camera
    alignment: Alignment
    covariance: FloatArray
    sigma: float

    @classmethod
    def of(cls, live: LiveAlignment) -> UncertainPose | None:
        """That of the pairs; None without one."""
        result = live.cautious
        covariance = None if result is None else result.covariance
        if result is None or covariance is None:
            return None
        return cls(result.camera, result.alignment, covariance, live.sigma)


@dataclass(frozen=True)
class Suggestion:
    """The next-best keypoint of the model, or a corner of the surface without a semantic id."""

    point: ModelKeypoint
    uv: tuple[float, float]  # its predicted place in the photo [px]
    next_best: NextBest | Unmarked


def suggest(
    model: ClickableModel,
    registry: KeypointRegistry,
    used: Collection[int],
    estimate: UncertainPose,
) -> Suggestion | None:
    """Choose among the visible keypoints that are not used; if none is left, among corners."""
    camera, alignment = estimate.camera, estimate.alignment
    own = [point for number, point in registry if number not in used]
    gaps = np.linalg.norm(model.sample_points[:, None] - registry.xyz(used), axis=2)
    apart = (gaps > _APART * model.diagonal).all(axis=1)
    corners = [point for point, far in zip(model.samples, apart.tolist(), strict=True) if far]
    for candidates in (own, corners):
        if not candidates:
            continue
        points = np.array([point.xyz for point in candidates])
        seen = np.flatnonzero(visible_keypoints(model.scene, points, camera, alignment))
        next_best = find_next_best(
            points[seen], camera, alignment, estimate.covariance, estimate.sigma
        )
        if next_best is not None:
            chosen = seen[next_best.row]
            ((u, v),) = camera.project(alignment.apply(points[chosen : chosen + 1])).tolist()
            return Suggestion(candidates[chosen], (u, v), next_best)
    return None


def suggest_of_shape(
    live: LiveShape, shape: ObjectShape, registry: KeypointRegistry, used: Collection[int]
) -> Suggestion | None:
    """Choose the visible keypoint whose measurement tells most about pose and shape.

    That is its mutual information with them, log det(I + C / sigma^2) / 2 for the predicted
    covariance C of its place in the photo.
    """
    result, camera, warped = live.shown, live.camera, live.warped
    if result is None or camera is None or warped is None or live.place:
        return None
    of_points = result.points_cam_covariance
    if of_points is None:
        return None
    own = {
        shape.id_of(point): point
        for number, point in registry
        if number not in used and shape.id_of(point) in result.ids
    }
    rows = np.array([row for row, label in enumerate(result.ids) if label in own], dtype=np.int64)
    points = result.points_3d[rows]
    seen = visible_keypoints(
        warped.wireframe.scene, points, camera, result.alignment, tolerance=_BENEATH
    )
    rows = rows[seen]
    if not len(rows):
        return None
    in_camera = result.alignment.apply(result.points_3d[rows])
    covariances = projected_covariances(in_camera, of_points[rows], camera)
    gain = np.linalg.slogdet(np.eye(2) + covariances / live.sigma**2)[1]
    best = int(np.argmax(np.round(gain, 9)))
    ((u, v),) = camera.project(in_camera[best : best + 1]).tolist()
    deviation = float(np.sqrt(np.trace(covariances[best])))
    return Suggestion(own[result.ids[rows[best]]], (u, v), Unmarked(deviation))


def find_next_best(
    points_3d: FloatArray,
    camera: Camera,
    alignment: Alignment,
    covariance: FloatArray,
    sigma: float,
) -> NextBest | None:
    """Choose the visible keypoint (n, 3) whose measurement shrinks the most uncertain unknown most.

    To be comparable, rotations count in radians, translations as shares of the distance, scales and
    focal length by their logarithms. Of equally good candidates the first is chosen; None if there
    are none, or nothing is uncertain.
    """
    weights = np.ones(len(covariance))
    weights[3:6] = 1 / max(float(np.linalg.norm(alignment.translation)), 1e-300)
    spread = np.sqrt(np.maximum(covariance.diagonal(), 0.0)) * weights
    worst = int(np.argmax(spread))
    if not len(points_3d) or not spread[worst] > 0:
        return None
    variances = updated_variances(points_3d, camera, alignment, covariance, sigma)[:, worst]
    # Rounded, so that candidates that are equal but for rounding are told apart by their order.
    row = int(np.argmin(np.round(variances / covariance[worst, worst], 9)))
    after = float(np.sqrt(max(variances[row], 0.0)) * weights[worst])
    return NextBest(row, worst, float(spread[worst]), after)


def updated_variances(
    points_3d: FloatArray,
    camera: Camera,
    alignment: Alignment,
    covariance: FloatArray,
    sigma: float,
) -> FloatArray:
    """The unknowns' variances (n, k) if one of n candidates is measured with this sigma [px].

    A measurement with the derivatives J turns the covariance C into
    C - C J' (J C J' + sigma^2)^-1 J C.
    """
    jacobian = projection_jacobian(points_3d, camera, alignment)[:, :, : len(covariance)]
    innovation = predicted_covariances(jacobian, covariance) + sigma**2 * np.eye(2)
    gain = covariance @ jacobian.transpose(0, 2, 1)
    shrunk = np.einsum("nka,nab,nkb->nk", gain, np.linalg.inv(innovation), gain)
    return np.asarray(covariance.diagonal() - shrunk)
