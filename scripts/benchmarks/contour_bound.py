"""The Cramer-Rao bound of one view's keypoints and mask."""

from __future__ import annotations

import numpy as np

from cadalign import Alignment, Model, View
from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.contours.mask import MaskSource
from cadalign.estimation.contours.outline import Track
from cadalign.estimation.contours.place import Place
from cadalign.estimation.contours.problem import ContourProblem
from cadalign.estimation.contours.surface import surface_of
from cadalign.estimation.estimates import mean_state, pose_and_border, pose_and_lengths
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import prior_of
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance

_REACH = 8.0  # [px]
_LEAST_OFFSET = 0.1  # [px], that the whole contour may have in common
_INLIER = 3.5  # in standard deviations


def contour_bound(model: Model, view: View, gt: Alignment) -> FloatArray:
    """The least covariance (9, 9) of an estimate from one view's keypoints and mask.

    It is in the form of `cadalign.Result.covariance`. The contour has the standard deviation and
    the correlation that its residuals show at the true alignment, which has the scale 1 along the
    model's known axis. Raises InputError if the view has no mask, its mask no contour, or the model
    no mesh or is not exact.
    """
    if view.mask_image is None or model.shape_sigma is not None:
        raise InputError("expected a view with a mask, and an exact model", where="view")
    evidence = evidence_of(prior_of(model), [view])
    state = mean_state(evidence, gt.packed[None, :12], np.log(gt.scale))
    keypoints = len(evidence.shape.mean) - 2
    surface = surface_of(model, evidence.shape.mean[:keypoints], "views[0].mask")
    source = MaskSource.of(0, view, view.camera)
    problem = ContourProblem(evidence, keypoints, [source], surface)
    track = Track(source.first().noise, _REACH, is_fine=True)
    look = problem.look(Place.of(state, 1), [track])
    (outline,) = look.outlines
    assert outline is not None
    centred = outline.places[outline.found]
    offset = float(np.median(centred)) if len(centred) else 0.0
    known = track.noise._replace(sigma=1.0, offset=max(abs(offset), _LEAST_OFFSET))
    own = np.array([offset / known.offset, 0.0, 0.0])
    noise = source.learned(outline, own, track._replace(noise=known)).noise
    residuals = np.abs(np.nan_to_num(outline.residuals(own, known)))
    agreeing = outline._replace(found=outline.found & (residuals < _INLIER * noise.sigma))
    augmented = problem.augmented(look._replace(outlines=[agreeing]), [noise])
    assert augmented is not None
    sightings = augmented.evidence.sightings
    linear = sightings._replace(loss=np.full_like(sightings.loss, LINEAR))
    ideal = augmented.evidence._replace(sightings=linear)
    unknowns = pose_and_border(joint_covariance(ideal, augmented.state), 0)
    return pose_and_lengths(ideal, augmented.state, unknowns)
