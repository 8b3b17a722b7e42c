"""The plain case, one view of keypoints of an exact or stretched model: what `fit` solves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.canonical import canonical_fit
from cadalign.fitting.fit import fit
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.prior import prior_of
from cadalign.fitting.joint.result import AlignAlternative, AlignResult
from cadalign.fitting.joint.summary import EvidenceSummary
from cadalign.fitting.joint.view import View
from cadalign.fitting.noise import pixel_information
from cadalign.fitting.options import RansacOptions
from cadalign.fitting.result import FitResult
from cadalign.fitting.symmetric import equal_text, held_axes, without_free_turns
from cadalign.fitting.uncertainty import unknown_axes
from cadalign.geometry.alignment import Alignment


def is_plain(model: object, views: Sequence[View]) -> bool:
    """True where nothing but the keypoints of one view and an exact model is given."""
    if not isinstance(model, Model) or model.shape_sigma is not None or len(views) != 1:
        return False
    view = views[0]
    others = (view.depth, view.up, view.cam_from_rig, view.mask, view.camera_height)
    return all(each is None for each in others)


def align_plain(
    model: Model, view: View, *, loss: str, loss_scale: float, ransac: RansacOptions | None
) -> AlignResult:
    """The result of `fit`, in the form of `align`'s."""
    prior = prior_of(model)
    points = cast(FloatArray, model.points_3d)
    rows = prior.rows_of(view.keypoint_ids, "views[0].ids")
    found = fit(
        points[rows],
        cast(FloatArray, view.points_2d),
        view.camera,
        sigma=view.sigma,
        loss=loss,
        loss_scale=loss_scale,
        stretch=model.stretch,
        scale_prior_sigma=model.scale_prior_sigma,
        known_axis=model.known_axis,
        ransac=ransac,
        confidences=view.confidences if ransac is not None else None,
    )
    columns = [0, 1, 2, 3, 4, 5, *(6 + axis for axis in unknown_axes(model.known_axis))]
    covariance = np.zeros((9, 9))
    of_others = [points] * len(found.alternatives)
    if model.symmetry is not None:
        found, best, others = canonical_fit(found, model.symmetry)
        points, of_others = best.relabelled(points), [each.relabelled(points) for each in others]
    if found.covariance is not None:
        covariance[np.ix_(columns, columns)] = found.covariance
    if model.symmetry is not None:
        covariance = without_free_turns(covariance, best)
    scale = found.alignment.scale
    of_points, of_seen = _points_covariances(points, found.alignment, covariance)
    bounds = cast(FloatArray, model.bounds)
    return AlignResult(
        alignment=found.alignment,
        ids=prior.ids,
        points_3d=points,
        bounds=bounds,
        poses=(found.alignment,),
        residuals=(found.residuals,),
        inliers=(found.inliers,),
        covariance=covariance,
        points_covariance=of_points,
        points_cam_covariance=of_seen,
        stretch=scale,
        component=0,
        model=model,
        alternatives=tuple(
            AlignAlternative(other.alignment, of_other, bounds, other.relative_likelihood)
            for other, of_other in zip(found.alternatives, of_others, strict=True)
        ),
        warnings=found.warnings,
        stats=found.stats,
        evidence=(_summary(found, view),),
        equal_under_symmetry=equal_text(
            found.alignment, model.symmetry, held=held_axes(found.stretched_axes)
        ),
        cameras=(view.camera,),
        observed=(cast(FloatArray, view.points_2d),),
    )


def _summary(found: FitResult, view: View) -> EvidenceSummary:
    """Agreement of the keypoints that the estimate rests on."""
    residuals = found.residuals[found.inliers]
    count = len(residuals)
    sigma = found.sigma if view.sigma is None else view.sigma
    squares = (residuals * residuals).sum()
    if isinstance(sigma, int | float):
        whitened = squares / sigma**2
    else:
        information = pixel_information(sigma, len(found.residuals))[found.inliers]
        whitened = np.einsum("ni,nij,nj->", residuals, information, residuals)
    in_sigmas = float(np.sqrt(whitened / (2 * count)))
    return EvidenceSummary("keypoints", 0, count, in_sigmas, float(np.sqrt(squares / count)), "px")


def _points_covariances(
    points: FloatArray, alignment: Alignment, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariances (m, 3, 3) of stretched points in the model's frame and in the camera's."""
    stretched = points * alignment.scale
    by_logs = stretched[:, :, None] * np.eye(3)
    of_points = by_logs @ covariance[6:, 6:] @ by_logs.swapaxes(1, 2)
    turned = stretched @ alignment.rotation.T
    by_turn = np.cross(np.eye(3), turned[:, None]).swapaxes(1, 2)  # columns: axis x turned
    shifts = np.broadcast_to(np.eye(3), by_turn.shape)
    rows = np.concatenate([by_turn, shifts, alignment.rotation @ by_logs], axis=2)
    return of_points, rows @ covariance @ rows.swapaxes(1, 2)
