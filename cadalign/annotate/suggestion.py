"""Next-best evidence: the keypoint that reduces the uncertainty most, and what to add beside it."""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from cadalign.annotate.estimate import LiveAlignment
from cadalign.annotate.live import short
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.models import KeypointRegistry, ObjectShape
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import CadalignError
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.uncertainty.next_best import LENGTH_SIGMA, TURN_DEG, Advice, rank_evidence
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import rescaled_pixels, resized_camera
from cadalign.render.raycast.renderer import cast_geometry
from cadalign.render.viewpoints import visible_keypoints
from cadalign.solvers.projection import predicted_covariances, projection_jacobian

UNKNOWNS = (
    *["the rotation"] * 3,
    *("the position sideways", "the height", "the distance"),
    *(f"the stretch along {axis}" for axis in "xyz"),
    "the focal length",
)
"""Names of the unknowns of a covariance, for a sentence."""
_ROTATIONS = 3
_BENEATH = 0.02  # depth of visible keypoints beneath the warped surface [diagonals]
_APART = 0.02  # least distance of a corner from marked points [diagonals]
_SUGGESTED = "suggested"
# Of the photo's longer side [px]: segmentation sees no more, and its errors grow with the photo.
_MASKED_AT = 1280

Observed = tuple[FloatArray, FloatArray, FloatArray]


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
class Suggestion:
    """The next-best keypoint of the model, or a corner of the surface without a semantic id."""

    point: ModelKeypoint
    uv: tuple[float, float]  # its predicted place in the photo [px]
    next_best: NextBest | float
    """What is gained; for an own shape the standard deviation of its place in the photo [px]."""


def suggest(
    live: LiveAlignment,
    model: ClickableModel,
    registry: KeypointRegistry,
    used: Collection[int],
    shape: ObjectShape,
) -> Suggestion | None:
    """Choose among the visible keypoints that are not used; if none is left, among corners.

    Nothing is predicted in another photo than the first, nor of a size that is estimated, too.
    """
    result = live.result
    if result is None or live.place or result.covariance is None:
        return None
    own = [point for number, point in registry if number not in used]
    if shape.is_estimated:
        return _suggest_of_shape(live, own, shape)
    if "x" in result.stretched_axes:
        return None
    gaps = np.linalg.norm(model.sample_points[:, None] - registry.xyz(used), axis=2)
    apart = (gaps > _APART * model.diagonal).all(axis=1)
    corners = [point for point, far in zip(model.samples, apart.tolist(), strict=True) if far]
    for candidates in (own, corners):
        if not candidates:
            continue
        points = np.array([point.xyz for point in candidates])
        seen = np.flatnonzero(visible_keypoints(model.scene, points, live.camera, live.alignment))
        next_best = find_next_best(
            points[seen], live.camera, live.alignment, result.covariance, live.sigma
        )
        if next_best is not None:
            chosen = int(seen[next_best.row])
            return _predicted(live, candidates[chosen], points[chosen], next_best)
    return None


def _suggest_of_shape(
    live: LiveAlignment, own: Sequence[ModelKeypoint], shape: ObjectShape
) -> Suggestion | None:
    """Choose the visible keypoint with the most information about pose and shape.

    It is the mutual information with them, log det(I + C / sigma^2) / 2 for the predicted
    covariance C of its place in the photo.
    """
    result, lines = live.result, live.wireframe
    if result is None or lines is None or result.points_cam_covariance is None:
        return None
    by_id: dict[Hashable, ModelKeypoint] = {shape.id_of(point): point for point in own}
    rows = np.array([row for row, each in enumerate(result.ids) if each in by_id], dtype=np.int64)
    points, pose = result.points_3d[rows], result.alignment
    seen = visible_keypoints(lines.scene, points, live.camera, pose, tolerance=_BENEATH)
    rows = rows[seen]
    if not len(rows):
        return None
    in_camera = pose.apply(result.points_3d[rows])
    of_points = result.points_cam_covariance[rows]
    covariances = live.camera.projected_covariances(in_camera, of_points)
    gain = np.linalg.slogdet(np.eye(2) + covariances / live.sigma**2)[1]
    best = int(np.argmax(np.round(gain, 9)))
    chosen, sigma = int(rows[best]), float(np.sqrt(np.trace(covariances[best])))
    return _predicted(live, by_id[result.ids[chosen]], result.points_3d[chosen], sigma)


def _predicted(
    live: LiveAlignment, point: ModelKeypoint, xyz: FloatArray, next_best: NextBest | float
) -> Suggestion:
    ((u, v),) = live.camera.project(live.alignment.apply(xyz[None])).tolist()
    return Suggestion(point, (u, v), next_best)


def find_next_best(
    points_3d: FloatArray,
    camera: Camera,
    alignment: Alignment,
    covariance: FloatArray,
    sigma: float,
) -> NextBest | None:
    """Choose the visible keypoint (n, 3) whose measurement shrinks the most uncertain unknown most.

    To be comparable, rotations count in radians, translations as shares of the distance, scales and
    focal length by their logarithms. The first of equally good candidates is chosen; None if there
    are none, or nothing is uncertain.
    """
    weights = np.ones(len(covariance))
    weights[3:6] = 1 / max(float(np.linalg.norm(alignment.translation)), 1e-300)
    spread = np.sqrt(np.maximum(covariance.diagonal(), 0.0)) * weights
    worst = int(np.argmax(spread))
    if not len(points_3d) or not spread[worst] > 0:
        return None
    variances = updated_variances(points_3d, camera, alignment, covariance, sigma)[:, worst]
    # Rounded, so that candidates that differ by rounding alone are chosen by their order.
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


def rank(
    model: ClickableModel, marked: Observed, result: Result, suggestion: Suggestion | None
) -> tuple[Advice, ...]:
    """Rank the suggested keypoint, a mask, another photo and lengths; empty if nothing is known.

    The pairs are (n, 3) model units, (n, 2) and (n,) px as they are aligned. They count as much as
    the standard deviations of the result say, which are calibrated for few of them. Masks are
    predicted for a photo of at most 1280 px.
    """
    points_3d, points_2d, sigmas = marked
    scene, alignment = model.light_scene, result.alignment
    times = max(1.0, max(result.camera.width, result.camera.height) / _MASKED_AT)
    width, height = result.camera.width, result.camera.height
    camera = resized_camera(
        result.camera, max(1, round(width / times)), max(1, round(height / times))
    )
    ids = tuple(range(len(points_3d)))
    suggested = [] if suggestion is None else [suggestion.point.xyz]
    candidates = (_SUGGESTED,) * len(suggested)
    exact = Model(
        points_3d=np.vstack([points_3d, *suggested]),
        ids=(*ids, *candidates),
        bounds=model.scene.bounds,
        mesh=scene.mesh,
        stretch_sigma=None if result.options is None else result.options.stretch_sigma,
    )
    sigma = _widening(result) * sigmas / times
    view = View(camera, rescaled_pixels(points_2d, 1 / times), ids=ids, sigma=sigma)
    mask = cast_geometry(scene, camera, alignment).mask
    # No contour is seen of an object beyond the image's borders.
    for given in (mask, None):
        try:
            ranked = rank_evidence(exact, view, alignment, candidates=candidates, mask=given)
        except CadalignError:
            continue
        return tuple(each for each in ranked if np.isfinite(each.worst))
    return ()


def present(result: Result) -> Advice | None:
    """The standard deviations as they are, without any addition."""
    std = result.std
    if std is None:
        return None
    distance = float(np.linalg.norm(result.alignment.translation))
    position = float(np.linalg.norm(std.translation)) / distance
    return Advice("nothing", "", std.rotation_deg, position, std.scale)


def warm_up_advice(points_3d: FloatArray, view: View, alignment: Alignment) -> None:
    """Compile or load what `rank` calls, by ranking what would help an alignment."""
    rank_evidence(Model(points_3d=points_3d), view, alignment)


def _widening(result: Result) -> float:
    """Mean ratio of the stated standard deviations to those of the linearised problem."""
    linear, calibrated = result.fisher_covariance, result.covariance
    if linear is None or calibrated is None:
        return 1.0
    known = linear.diagonal() > 0
    return float(np.sqrt(np.mean(calibrated.diagonal()[known] / linear.diagonal()[known])))


def next_best_text(next_best: NextBest | float, name: str) -> str:
    """Name of the next-best keypoint, and what is gained by it."""
    if isinstance(next_best, float):
        known = f"so far known to ± {short(next_best)} px"
        return f"{name}: {known}; it would tell most about pose and shape"
    factor, unit = (100, " %") if next_best.unknown >= _ROTATIONS else (math.degrees(1), "°")
    before, after = (short(factor * std) + unit for std in (next_best.before, next_best.after))
    unknown = UNKNOWNS[next_best.unknown]
    return f"{name}: it would determine {unknown} to ± {after} instead of {before}"


def name_of(suggestion: Suggestion) -> str:
    """Name of a suggested point."""
    return suggestion.point.name or "The marked corner"


def evidence_text(advice: Advice, keypoint: str) -> str:
    """One piece of evidence; a keypoint by its name."""
    if advice.kind == "keypoint":
        return keypoint
    if advice.kind == "view":
        return f"A second photo of these points, from {TURN_DEG:.0f}° aside"
    if advice.kind == "mask":
        return "A mask of the object"
    return f"{str(advice.detail).capitalize()}, measured to {100 * LENGTH_SIGMA:.0f} %"


def how_text(advice: Advice, observation: str) -> str:
    """Advice on adding a piece of evidence to the observation file of the name; none for pairs."""
    by = {
        "mask": "Start with --mask mask.png, an image of the photo's size that is not 0 on the "
        'object; or write "mask": "mask.png"',
        "view": "Start with a folder of photos, or with --further-photos right.jpg, and add the "
        "photo by 'Objects…' (T), which writes it",
        "lengths": "Start with --size width 0.45 height 0.91 sigma 0.01, in model units; or write "
        '"size": {"width": 0.45, "height": 0.91, "sigma": 0.01}',
    }
    return f"{by[advice.kind]} into {observation}." if advice.kind in by else ""


def left_text(advice: Advice) -> str:
    """The largest standard deviation that is left with a piece of evidence."""
    if advice.worst > 1:  # a relative standard deviation of 100 %
        return "something stays undetermined"
    if advice.worst == math.radians(advice.rotation_deg):
        return f"rotation to ± {short(advice.rotation_deg)}°"
    percent = f"± {short(100 * advice.worst)} %"
    if advice.worst == advice.position:
        return f"position to {percent}"
    return f"stretch along {'xyz'[advice.stretch.index(advice.worst)]} to {percent}"
