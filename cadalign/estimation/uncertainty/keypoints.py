"""Uncertainty of keypoints of an exact or stretched model in one view, and warnings about them."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.fitted import Diagnosis, FittedKeypoints
from cadalign.estimation.focal import focal_doubt
from cadalign.estimation.options import pixel_information
from cadalign.estimation.uncertainty.misfit import (
    Misfit,
    find_misfit,
    is_large_sigma,
    unexplained,
    unverified_stretch,
)
from cadalign.estimation.uncertainty.posterior import posterior_covariance
from cadalign.estimation.uncertainty.summary import (
    EvidenceSummary,
    another_pose,
    weaknesses_of_keypoints,
)
from cadalign.estimation.warning import EstimateWarning, Warnings
from cadalign.geometry.camera import Camera


def keypoint_covariance(fitted: FittedKeypoints) -> FloatArray | None:
    """The covariance (9, 9) or (10, 10) by the posterior; None without a Fisher information.

    Rotations about the axes of a symmetry count nothing.
    """
    if fitted.fisher_covariance is None:
        return None
    covariance = posterior_covariance(fitted)
    if fitted.symmetry is None:
        return covariance
    from cadalign.estimation.symmetry import held_axes, without_free_turns
    from cadalign.geometry.symmetry_group import group_of  # most models have none

    held = held_axes(fitted.options.stretched_axes)
    best = group_of(fitted.symmetry).canonical(fitted.alignment, held=held)
    return without_free_turns(covariance, best)


def keypoint_warnings(
    fitted: FittedKeypoints, covariance: FloatArray | None, diagnosis: Diagnosis | None
) -> Warnings:
    """Warnings about mistakes, a misfit, and what the keypoints do not determine.

    The ``diagnosis`` names a mistake in keypoints that fail their test.
    """
    misfit = find_misfit(fitted)
    ahead = np.isfinite(fitted.residuals).all(axis=1)
    observed = fitted.observed[ahead]
    if diagnosis is not None and _is_doubtful(fitted, misfit):
        rival = None if misfit is None else misfit.camera
        has_reason = misfit is not None and misfit.has_reason
        mistake = diagnosis(fitted, has_reason=has_reason, rival=rival)
        if mistake is not None:  # nothing else can be said of the alignment
            return (mistake,)
    placed = _placed(fitted.camera, observed, misfit)
    if covariance is None:
        return placed
    kept, options = fitted.points_3d[fitted.inliers], fitted.options
    is_estimated = options.focal == "estimate"
    weak = weaknesses_of_keypoints(
        kept,
        fitted.alignment,
        covariance,
        redundancy=2 * len(kept) - options.unknowns,
        stretch_sigma=options.stretch_sigma,
        doubt=focal_doubt(fitted.camera, options.focal_prior) if is_estimated else None,
    )
    others: Warnings = ()
    # Likelihoods tell nothing where keypoints do not fit, or others than these were rejected.
    if misfit is None and fitted.search is None:
        poses = [(each.alignment, each.relative_likelihood) for each in fitted.alternatives]
        others = another_pose(fitted.alignment, poses, covariance)
    return (*placed, *_doubts(fitted, misfit, observed), *weak, *others)


def _is_doubtful(fitted: FittedKeypoints, misfit: Misfit | None) -> bool:
    """True if keypoints fail their test, or those that agree were searched for."""
    if fitted.search is not None:
        return True
    if fitted.fisher_covariance is None:
        return False
    if misfit is not None or fitted.options.sigma is not None or fitted.sigma is None:
        return misfit is not None
    return is_large_sigma(fitted.sigma, [fitted.observed[fitted.inliers]])


def _placed(camera: Camera, observed: FloatArray, misfit: Misfit | None) -> Warnings:
    if camera.is_centred and camera.contains(observed).all():
        return ()
    from cadalign.estimation.uncertainty.summary import outside_image  # rarely asked

    return outside_image(observed, camera, agree=misfit is None)


def _doubts(
    fitted: FittedKeypoints, misfit: Misfit | None, observed: FloatArray
) -> list[EstimateWarning]:
    """Warnings about residuals, the noise, held scales, and support by chance."""
    found = [unverified_stretch(fitted) if misfit is None else misfit.warning]
    if fitted.sigma is not None and fitted.options.sigma is None:
        found.extend(unexplained(fitted.sigma, [observed]))
    if fitted.search is not None:
        found.append(fitted.search.doubt(fitted.residuals, fitted.inliers))
    return [each for each in found if each is not None]


def keypoint_evidence(fitted: FittedKeypoints) -> tuple[EvidenceSummary, ...]:
    """Agreement of the keypoints that the estimate rests on."""
    residuals = fitted.residuals[fitted.inliers]
    count = max(len(residuals), 1)
    rms = float(np.sqrt((residuals * residuals).sum() / count))
    sigma = fitted.chosen_sigma
    if np.ndim(sigma) == 0:
        unit = 1.0 if sigma is None else float(sigma)
        with np.errstate(over="ignore"):  # of the least positive number
            in_sigmas = float(np.nan_to_num(np.divide(rms / np.sqrt(2.0), unit)))
    else:
        information = pixel_information(sigma, len(fitted.residuals))[fitted.inliers]
        whitened = np.einsum("ni,nij,nj->", residuals, information, residuals)
        in_sigmas = float(np.sqrt(whitened / (2 * count)))
    return (EvidenceSummary("keypoints", 0, len(residuals), in_sigmas, rms, "px"),)
