"""Contours of masks at a known alignment: the Cramer-Rao bound of keypoints and masks together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.contours.noise import OWN_MODES, Noise, noise_of
from cadalign.estimation.contours.rims import extraction_bias, find_rims
from cadalign.estimation.contours.rows import (
    Measured,
    count_of,
    state_with_points,
    with_measured,
)
from cadalign.estimation.contours.surface import PosedSurface, surfaces_of
from cadalign.estimation.contours.view_contour import ViewContour, contour_view
from cadalign.estimation.estimates import pose_and_border, pose_and_lengths, poses_of
from cadalign.estimation.model import Model
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import prior_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import Evidence, State

_INLIER = 3.5  # in deviations
_BOUND_REACH = 8.0  # [px]
_LEAST_COMMON_OFFSET = 0.1  # [px], that the whole contour may have in common


def contour_bound(model: Model, view: View, gt: Alignment) -> FloatArray:
    """The least covariance of an estimate from one view's keypoints and mask.

    The contour has the deviation and the correlation that its residuals show at the true alignment,
    which has the scale 1 along the model's known axis.

    Returns
    -------
    (9, 9) float
        As `cadalign.Result.covariance`.

    Raises
    ------
    InputError
        If the view has no mask, or the model is not exact.
    """
    if view.mask_image is None or model.shape_sigma is not None:
        raise InputError("expected a view with a mask, and an exact model", where="view")
    evidence = evidence_of(prior_of(model), [view], None, loss=LINEAR, loss_scale=1.0)
    pose = np.concatenate([gt.rotation.ravel(), gt.translation])[None]
    still = np.zeros_like(evidence.shape.mean)
    state = State(pose, np.zeros(0), np.log(gt.scale), np.zeros(len(evidence.shape.modes)), still)
    full, stacked = with_contours(model, [view], evidence, state)
    unknowns = pose_and_border(joint_covariance(full, stacked), 0)
    return pose_and_lengths(full, stacked, unknowns)


def with_contours(
    model: Model, views: Sequence[View], evidence: Evidence, state: State
) -> tuple[Evidence, State]:
    """The evidence of an exact model's views with the contours of their masks.

    Their deviation and correlation are those that their residuals show at the state.

    Raises
    ------
    InputError
        If a mask has no contour, or the model has no mesh.
    """
    masked = [number for number, view in enumerate(views) if view.mask_image is not None]
    if not masked:
        return evidence, state
    keypoints = len(evidence.shape.mean) - 2
    where = f"views[{masked[0]}].mask"
    (surface,), _ = surfaces_of(model, evidence.shape.mean[:keypoints], where)
    posed = surface.at(evidence.shape, state)
    poses = poses_of(evidence, state)
    rows = [
        _contour_rows(contour_view(n, views[n], f"views[{n}].mask"), posed, poses[n])
        for n in masked
    ]
    full = with_measured(evidence, keypoints, rows)
    return full, state_with_points(
        state, keypoints, count_of(rows), np.zeros(OWN_MODES * len(rows))
    )


def _contour_rows(seen: ViewContour, posed: PosedSurface, gt: Alignment) -> Measured:
    rims = find_rims(posed.caster, seen.camera, gt, seen.contour, _BOUND_REACH)
    offset = float(np.median(rims.offset[rims.found])) if rims.found.any() else 0.0
    centred = np.where(rims.found, rims.offset - offset, np.nan)
    known = Noise(1.0, 1.0, max(abs(offset), _LEAST_COMMON_OFFSET))
    bias = extraction_bias(posed.caster, seen.camera, gt, seen.mask, seen.contour, rims)
    noise = noise_of(seen.contour, seen.sigma, rims, centred - bias, known, correlated=True)
    agreeing = rims.found & (np.abs(np.nan_to_num(centred - bias)) < _INLIER * noise.sigma)
    rows = seen.evidence_of(
        rims._replace(found=agreeing), noise, posed, gt, camera=seen.camera, bias=bias
    )
    return rows._replace(table=rows.table._replace(loss=np.full_like(rows.table.loss, LINEAR)))
