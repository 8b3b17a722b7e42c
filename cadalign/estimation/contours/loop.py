"""Fit the model's rim to masks' contours, together with all other evidence.

Each round finds the rims at the present estimate, adds them to the evidence as contour sightings
of points of the shape, and refines everything. That a rim moves along the surface as the pose
changes does not count to first order, so the rounds converge as fast as Gauss-Newton steps do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.contours.contour import (
    Contour,
    correlation_length,
    mask_contour,
    robust_deviation,
)
from cadalign.estimation.contours.rims import (
    MaskImage,
    Rims,
    extraction_bias,
    find_rims,
    mask_image,
)
from cadalign.estimation.contours.rows import (
    Measured,
    count_of,
    state_with_points,
    state_without_points,
    with_measured,
)
from cadalign.estimation.contours.surface import PosedSurface, Surface
from cadalign.estimation.estimates import poses_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.solvers.constants import CAUCHY
from cadalign.solvers.joint.covariance import information_of
from cadalign.solvers.joint.evidence import Evidence, Sightings, State, log_focals_of
from cadalign.solvers.joint.search import refine_joint, score_state

_FIRST_REACH = 24.0  # [px], and the same relative to the contour's size
_RELATIVE_REACH = 0.04
_WIDE_REACH = 0.15  # where nothing but the masks determines the estimate
_LEAST_REACH = 4.0
_REACH = 6.0  # in deviations of the residuals
_COARSE_ROUNDS = 20
_FINE_ROUNDS = 4
_ITERATIONS = 12
_SETTLED = 0.02  # [px], median change of the offsets from round to round, or in deviations
_LEAST_SIGMA = 0.1  # [px]
_LOSS_SCALE = 2.4  # in deviations: Cauchy's loss then keeps 95 % of the information
_FIRST_OFFSET = 1.0  # [px], deviation of the offset that all of a contour has in common
_LEAST_OFFSET = 0.1
_UNEVEN = 0.05  # share of the offset by which it differs from edge to edge
_EDGE = 30.0  # samples of an edge
_OF_PIXELS = 3.0  # samples that count as one where pixels alone displace them
_FIRST_CORRELATION = 10.0  # samples, of a surface that is only similar
_LEAST_INFORMATION = 1e-12  # about an unknown, relative


@dataclass(frozen=True, eq=False)
class ViewContour:
    """The contour in view number ``image``.

    ``rays`` (S, 2) are its samples, ``across`` (S, 2) the derivative of the place along the normal
    [px] by the ray; ``sigma`` is the given deviation [px], None to estimate it. The contour is that
    of ``mask``.
    """

    image: int
    camera: Camera
    contour: Contour
    rays: FloatArray
    across: FloatArray
    sigma: float | None
    mask: MaskImage


class Noise(NamedTuple):
    """Deviation of a contour [px], number of samples that count as one, deviation of the offset."""

    sigma: float
    correlation: float
    offset: float


class ContourFit(NamedTuple):
    """A view's contour at an estimate: rims, residuals (S,) [px] with the offset removed, noise."""

    rims: Rims
    residuals: FloatArray
    noise: Noise
    offset: float


class Settled(NamedTuple):
    """An estimate from all evidence; ``evidence`` and ``state`` hold the rims."""

    evidence: Evidence
    state: State
    bare: State
    fits: tuple[ContourFit, ...]
    cost: float
    score: float
    rounds: int


def contour_view(image: int, view: View, where: str, camera: Camera | None = None) -> ViewContour:
    """The contour of a view's mask, with what the sightings need of the camera.

    Samples outside of its lens are dropped.

    Raises
    ------
    InputError
        If the mask ``where`` has no contour.
    """
    camera = view.camera if camera is None else camera
    mask = cast("FloatArray | BoolArray", view.mask_image)
    contour = mask_contour(mask, where)
    rays, valid = camera.normalize_where_valid(contour.points)
    kept = contour.taken(valid)
    rays = rays[valid]
    slopes = np.array([[camera.fx], [camera.fy]]) * camera.distortion_jacobian(rays)
    across = np.einsum("ni,nij->nj", kept.normals, slopes)
    return ViewContour(image, camera, kept, rays, across, view.mask_sigma, mask_image(mask))


def settle(
    evidence: Evidence,
    keypoints: int,
    state: State,
    views: list[ViewContour],
    surface: Surface,
    noises: list[Noise] | None = None,
    *,
    is_wide: bool = False,
) -> Settled | None:
    """Rounds from one start until they change little; None where no rim comes near a contour.

    With ``noises`` these are kept, so that the scores of several estimates compare. ``is_wide``
    says that the start may be far off.
    """
    offsets = np.zeros(len(views))
    share = _WIDE_REACH if is_wide else _RELATIVE_REACH
    reach = max(_FIRST_REACH, *(share * view.contour.size for view in views))
    if noises is not None:
        reach = min(reach, _reach_of(max(noise.sigma for noise in noises)))
    current = noises or [_first_noise(view, reach, is_exact=surface.is_exact) for view in views]
    fine = 0
    last: list[Rims] = []
    for number in range(_COARSE_ROUNDS):
        posed = surface.at(evidence.shape, state)
        poses = poses_of(evidence, state)
        cameras = [camera_at(view, evidence, state) for view in views]
        rims = [
            find_rims(posed.caster, camera, poses[view.image], view.contour, reach)
            for view, camera in zip(views, cameras, strict=True)
        ]
        moved = _change(last, rims)
        widest = max(noise.sigma for noise in current)
        if fine or moved < _SETTLED * max(1.0, widest) or number >= _COARSE_ROUNDS - _FINE_ROUNDS:
            fine += 1
        biases = [np.zeros(len(each.found)) for each in rims]
        if fine and surface.is_exact:
            biases = [
                extraction_bias(
                    posed.caster, camera, poses[view.image], view.mask, view.contour, each
                )
                for view, camera, each in zip(views, cameras, rims, strict=True)
            ]
        residuals = [
            np.where(each.found, each.offset + offset * noise.offset, np.nan)
            for each, offset, noise in zip(rims, offsets, current, strict=True)
        ]
        if noises is None:
            before = current
            current = [
                noise_of(view, each, residual - bias, noise, correlated=fine > 0)
                if surface.is_exact
                else _noise_of_similar(view, each, residual, reach)
                for view, each, residual, bias, noise in zip(
                    views, rims, residuals, biases, current, strict=True
                )
            ]
            if surface.is_exact:
                reach = min(reach, _reach_of(max(noise.sigma for noise in current)))
        rows = [
            rim_rows(view, each, noise, posed, poses[view.image], bias)
            for view, each, noise, bias in zip(views, rims, current, biases, strict=True)
        ]
        if not count_of(rows):
            return None
        full = with_measured(evidence, keypoints, rows)
        if noises is None:
            offsets = offsets * [b.offset / n.offset for b, n in zip(before, current, strict=True)]
        total = count_of(rows)
        stacked = state_with_points(state, keypoints, total, offsets)
        cost, stacked, _, _ = refine_joint(full, _ITERATIONS, stacked)
        if not cost < np.inf:
            return None
        state, offsets = state_without_points(stacked, keypoints, total, len(rows))
        if noises is None and surface.is_exact:
            current, offsets = _relearned(full, stacked, current, offsets)
        last = rims
        if fine > _FINE_ROUNDS or (fine > 1 and noises is not None):
            break
    unmatched = sum(
        _cauchy(reach, noise) * int((~each.found).sum())
        for each, noise in zip(rims, current, strict=True)
    )
    score = score_state(full, stacked) + unmatched
    fits = tuple(
        ContourFit(each, residual, noise, offset * noise.offset)
        for each, residual, noise, offset in zip(rims, residuals, current, offsets, strict=True)
    )
    return Settled(full, stacked, state, fits, cost, score, number + 1)


def _reach_of(sigma: float) -> float:
    return max(_REACH * sigma, _LEAST_REACH)


def _cauchy(residual: float, noise: Noise) -> float:
    """Cost of one sample's residual [px]."""
    square = (_LOSS_SCALE**2) / noise.correlation
    return float(square * np.log1p((residual / noise.sigma / _LOSS_SCALE) ** 2))


def _change(last: list[Rims], rims: list[Rims]) -> float:
    """Median change of the rims' offsets [px] since the last round; infinite in the first."""
    if not last:
        return np.inf
    changes = [np.zeros(0)]
    for before, after in zip(last, rims, strict=True):
        both = before.found & after.found
        changes.append(np.abs(after.offset - before.offset)[both])
    every = np.concatenate(changes)
    return float(np.median(every)) if len(every) else np.inf


def noise_of(
    view: ViewContour, rims: Rims, residuals: FloatArray, noise: Noise, *, correlated: bool
) -> Noise:
    """Deviation and correlation that the residuals (S,) [px] show, free of the extraction's bias.

    The correlation is that of the samples' influence on the estimate, which runs of outliers have,
    too; what the residuals don't reach of the deviation is correlated as pixels are. A contour
    beside the rim lies there unevenly, by a share of the offset that all of an edge has in common.
    """
    found = robust_deviation(residuals[rims.found])
    measured = max(found, _LEAST_SIGMA)
    sigma = measured if view.sigma is None else view.sigma
    length = 1.0
    if correlated:
        some = np.nan_to_num(residuals)
        influence = some / (1 + (some / (_LOSS_SCALE * measured)) ** 2)
        share = min((found / sigma) ** 2, 1.0)
        along = correlation_length(view.contour, influence, rims.found)
        length = share * along + (1 - share) * _OF_PIXELS
        length += _EDGE * (_UNEVEN * noise.offset / sigma) ** 2
    return Noise(sigma, length, noise.offset)


def _first_noise(view: ViewContour, reach: float, *, is_exact: bool) -> Noise:
    if is_exact:
        return Noise(view.sigma or reach / 3, 1.0, _FIRST_OFFSET)
    return Noise(reach / 3, _FIRST_CORRELATION, _LEAST_OFFSET)


def _noise_of_similar(view: ViewContour, rims: Rims, residuals: FloatArray, reach: float) -> Noise:
    """Deviation and correlation where the surface is only similar to the object's.

    Samples without a rim count as the farthest: there the surface lacks a part or has one more.
    """
    everywhere = np.nan_to_num(residuals, nan=reach)
    sigma = max(robust_deviation(everywhere), view.sigma or _LEAST_SIGMA)
    length = correlation_length(view.contour, np.nan_to_num(residuals), rims.found)
    return Noise(sigma, length, _LEAST_OFFSET)


def _relearned(
    evidence: Evidence, state: State, noises: list[Noise], offsets: FloatArray
) -> tuple[list[Noise], FloatArray]:
    """Deviations of the offsets by their own likelihood, and the offsets in these deviations."""
    _, information = information_of(evidence, state)
    size = len(information)
    own = np.arange(size - len(noises), size)
    sizes = np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scaled = information / np.outer(sizes, sizes) + _LEAST_INFORMATION * np.eye(size)
    columns = np.linalg.solve(scaled, np.eye(size)[:, own])
    variances = columns[own].diagonal() / sizes[own] ** 2
    learned, coefficients = [], []
    for noise, coefficient, variance in zip(noises, offsets, variances, strict=True):
        without_prior = 1 / max(1 / min(variance, 1.0) - 1, 1e-6)  # in squares of noise.offset
        free = coefficient * (1 + without_prior)
        square = noise.offset**2 * max(free**2 - without_prior, 0.0)
        deviation = max(np.sqrt(square), _LEAST_OFFSET)
        learned.append(noise._replace(offset=deviation))
        coefficients.append(coefficient * noise.offset / deviation)
    return learned, np.array(coefficients)


def rim_rows(
    view: ViewContour,
    rims: Rims,
    noise: Noise,
    surface: PosedSurface,
    pose: Alignment,
    bias: FloatArray,
) -> Measured:
    """The rims that were found, in the form of the evidence.

    They are to lie outside of the contour by the ``bias`` (S,) of its extraction [px]; the mode of
    the points alone moves every rim outwards by one deviation of the contour's common offset.
    """
    kept = np.flatnonzero(rims.found)
    points = rims.points[kept]
    count = len(kept)
    across = view.across[kept]
    depth = pose.apply(points)[:, 2]
    # A step along this direction of the ray moves the image by one pixel along the normal.
    step = across / (across**2).sum(axis=1, keepdims=True)
    outwards = np.column_stack([step * depth[:, None], np.zeros(count)])
    weight = 1 / (noise.sigma * np.sqrt(noise.correlation))
    return Measured(
        surface.rows(points, rims.face[kept]),
        Sightings(
            kept,
            np.full(count, view.image),
            view.rays[kept] + bias[kept, None] * step,
            np.column_stack([across * weight, np.zeros(count)]),
            np.zeros((count, 2)),
            np.full(count, CAUCHY),
            np.full(count, _LOSS_SCALE / np.sqrt(noise.correlation)),
            np.zeros((count, 2)),
        ),
        noise.offset * (outwards @ pose.rotation) / pose.scale,
    )


def camera_at(view: ViewContour, evidence: Evidence, state: State) -> Camera:
    """The camera of a view, with the focal length that a state has."""
    if evidence.focals.group[view.image] < 0:
        return view.camera
    ratio = np.exp(log_focals_of(evidence, state)[view.image])
    return view.camera.with_focal(view.camera.fx * float(ratio))
