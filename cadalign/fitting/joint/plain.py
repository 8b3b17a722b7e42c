"""The plain case, one view of keypoints of an exact or stretched model: what `fit` solves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.fitting.fit import fit
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.prior import prior_of
from cadalign.fitting.joint.result import AlignAlternative, AlignResult
from cadalign.fitting.joint.view import View
from cadalign.fitting.options import RansacOptions
from cadalign.fitting.uncertainty import unknown_axes


def is_plain(model: object, views: Sequence[View]) -> bool:
    """True where nothing but the keypoints of one view and an exact model is given."""
    if not isinstance(model, Model) or model.shape_sigma is not None or len(views) != 1:
        return False
    view = views[0]
    return view.depth is None and view.up is None and view.cam_from_rig is None


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
    if found.covariance is not None:
        covariance[np.ix_(columns, columns)] = found.covariance
    scale = found.alignment.scale
    stretched = points * scale
    of_points = np.zeros((len(points), 3, 3))
    for first in range(3):
        for second in range(3):
            products = stretched[:, first] * stretched[:, second]
            of_points[:, first, second] = products * covariance[6 + first, 6 + second]
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
        stretch=scale,
        component=0,
        model=model,
        alternatives=tuple(
            AlignAlternative(other.alignment, points, bounds, other.relative_likelihood)
            for other in found.alternatives
        ),
        warnings=found.warnings,
        stats=found.stats,
    )
