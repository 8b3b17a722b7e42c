"""Cramer-Rao bound of keypoints and masks together, for a known true alignment."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.fitting.contours.choice import surfaces_of
from cadalign.fitting.contours.loop import Noise, contour_view, noise_of, rim_rows
from cadalign.fitting.contours.mask import mask_contour
from cadalign.fitting.contours.rims import find_rims
from cadalign.fitting.contours.stack import with_rims, with_room
from cadalign.fitting.joint.deviations import pose_and_lengths
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.pack import evidence_of
from cadalign.fitting.joint.prior import prior_of
from cadalign.fitting.joint.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance
from cadalign.solvers.joint.evidence import State

_REACH = 8.0  # [px]
_INLIER = 3.5  # in deviations
_LEAST_OFFSET = 0.1  # [px], that the whole contour may have in common


def contour_bound(model: Model, view: View, gt: Alignment) -> FloatArray:
    """The least covariance of an estimate from one view's keypoints and mask.

    The contour has the deviation and the correlation that its residuals show at the true alignment,
    which has the scale 1 along the model's known axis.

    Returns
    -------
    (9, 9) float
        As `AlignResult.covariance`.

    Raises
    ------
    InputError
        If the view has no mask, or the model is not exact.
    """
    if view.mask_image is None or model.shape_sigma is not None:
        raise InputError("expected a view with a mask, and an exact model", where="view")
    prior = prior_of(model)
    evidence = evidence_of(prior, [view], None, loss=LINEAR, loss_scale=1.0)
    contour = mask_contour(view.mask_image, "view.mask")
    seen = contour_view(0, view.camera, contour, view.mask_sigma)
    (surface,) = surfaces_of(model, evidence.shape.mean[: len(prior.ids)], "view.mask")
    pose = np.concatenate([gt.rotation.ravel(), gt.translation])[None]
    still = np.zeros_like(evidence.shape.mean)
    state = State(pose, np.log(gt.scale), np.zeros(len(evidence.shape.modes)), still)
    posed = surface.at(evidence.shape, state)
    rims = find_rims(posed.caster, view.camera, gt, contour, _REACH)
    offset = float(np.median(rims.offset[rims.found]))
    centred = np.where(rims.found, rims.offset - offset, np.nan)
    known = Noise(1.0, 1.0, max(abs(offset), _LEAST_OFFSET))
    noise = noise_of(seen, rims, centred, known, correlated=True)
    agreeing = rims.found & (np.abs(np.nan_to_num(centred)) < _INLIER * noise.sigma)
    rows = [rim_rows(seen, rims._replace(found=agreeing), noise, posed, gt)]
    rows = [rows[0]._replace(loss=np.full(len(rows[0].loss), LINEAR))]
    full = with_rims(evidence, len(prior.ids), rows)
    stacked = with_room(state, len(prior.ids), rows, np.zeros(1))
    return pose_and_lengths(full, stacked, joint_covariance(full, stacked).unknowns)
