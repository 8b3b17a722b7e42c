"""Warnings about an estimate: no redundancy, other poses, keypoints outside the image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.options import USUAL_STRETCH, FitOptions, RansacOptions, Sigma
from cadalign.estimation.result_parts import Diagnosis, EstimateWarning, FittedKeypoints, Warnings
from cadalign.estimation.uncertainty.residuals import chance_of
from cadalign.geometry.alignment import Alignment, Uncertainty, uncertainty_of
from cadalign.geometry.calibration import camera_doubts
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.io.focal import PriorOption, prior_of_camera
from cadalign.shapes.parts import probability_within
from cadalign.solvers.constants import LEAST_POINTS

FALSE_ALARMS = 0.004
"""Significance level of the test of residuals."""
_LARGE = 0.005  # of a large estimated sigma, relative to the keypoints' extent
_LARGEST_SHARE = 0.45  # of an estimated sigma in the keypoints' spread
_LEAST_EXTENT = 5.0  # of keypoints [sigma]
_MOST_REJECTED = 0.3  # share of the keypoints that a robust search rejects without a warning
_NEAR = 3.0  # largest error of a near outlier, relative to the threshold
_CONTRADICTING_SIGMAS = 3.0  # of an estimated focal length from its prior
_BEYOND_PRIOR = 3.5  # stretch, in standard deviations of its prior
_LEAST_GAIN = 0.9  # of a standard deviation, relative to uniform rotations
_ANY_ROTATION = math.sqrt(math.pi**2 / 3 + 2)  # standard deviation of uniform rotations [rad]
_ANOTHER_DEG = 10.0
_LEAST_TURN = 1e-12  # [rad], and of a relative variance
_REGION = 0.95  # probability of the confidence region, which excludes alternatives outside


def keypoint_warnings(
    fitted: FittedKeypoints, covariance: FloatArray | None, diagnosis: Diagnosis | None
) -> Warnings:
    """Warnings about a misfit, and about problems that deviations do not show."""
    cause = None if diagnosis is None or _fits(fitted) else diagnosis(fitted)
    counted, residuals = fitted.is_counted, fitted.residuals
    observed = fitted.observed[np.isfinite(residuals).all(axis=1) & counted]
    is_mistake = cause is not None and cause.kind == "mistake"
    sigma = fitted.options.sigma
    placed = outside_image(observed, fitted.camera, cause=cause, sigma=sigma)
    found = order_warnings(placed, cause)
    for row, first in fitted.repeats:
        text = f"keypoint {row} is keypoint {first} again, and counts once"
        found.append(EstimateWarning("left-out", text, 0, (row,)))
    if covariance is None or is_mistake:  # the alignment is meaningless
        return tuple(found)
    options, kept = fitted.options, fitted.points_3d[fitted.inliers]
    if fitted.sigma is not None and options.sigma is None:
        found += noise_doubts(fitted.sigma, [observed])
    if fitted.ransac is not None and fitted.doubt is not None:
        agreeing = residuals[counted], fitted.inliers[counted]
        chance = fitted.doubt(*agreeing)
        found += () if chance is None else (chance,)
        found += rejections(*agreeing, fitted.ransac, sigma)
    if 2 * len(kept) <= options.unknowns:
        text = (
            f"{len(kept)} keypoints always fit exactly: "
            "the residuals say nothing about the quality of the fit"
        )
        found.append(EstimateWarning("untested", text))
    if options.focal == "estimate":
        doubt = focal_doubt(fitted.camera, options.focal_prior)
        found += () if doubt is None else (doubt,)
    if cause is None:
        found += stretch_doubts(fitted.alignment, uncertainty_of(covariance), options)
    # Likelihoods are meaningless after a misfit, or with different outliers.
    if cause is None and fitted.ransac is None:
        poses = [(each.alignment, each.relative_likelihood) for each in fitted.alternatives]
        found += pose_doubts(fitted.alignment, poses, covariance)
    return tuple(found)


def focal_doubt(camera: Camera, prior: PriorOption) -> EstimateWarning | None:
    """Warn if the estimated focal length contradicts its prior."""
    prior = prior_of_camera(prior, camera)
    if prior is None:
        return None
    if abs(math.log(camera.fx / prior.focal)) <= _CONTRADICTING_SIGMAS * prior.relative_sigma:
        return None
    return EstimateWarning(
        "focal",
        f"the keypoints contradict the focal length's prior: {camera.fx:.4g} px instead of {prior}",
    )


def order_warnings(placed: Warnings, cause: EstimateWarning | None) -> list[EstimateWarning]:
    """Join warnings of `outside_image` and the cause of a misfit; camera warnings come first."""
    doubts = [each for each in placed if each.kind == "camera"]
    return [*doubts, *(() if cause is None else (cause,)), *placed[len(doubts) :]]


def _fits(fitted: FittedKeypoints) -> bool:
    if fitted.ransac is not None or fitted.cost is None:
        return fitted.ransac is None
    if fitted.options.sigma is None:
        return not is_large_sigma(fitted.sigma or 0.0, [fitted.observed[fitted.inliers]])
    return chance_of(fitted.cost, fitted.redundancy) >= FALSE_ALARMS


def percent(fraction: float) -> str:
    """A share in percent, for a sentence."""
    return f"{100 * fraction:.0f} %" if fraction < 100 else "more than 10000 %"


def pose_doubts(
    best: Alignment,
    others: Sequence[tuple[Alignment, float]],
    covariance: FloatArray,
    degrees_of_freedom: float | None = None,
    *,
    near: float = 0.0,
) -> Warnings:
    """Warn about other poses, with relative likelihoods, that the deviations do not cover.

    These lie outside the 95 % interval of the turn to them, and have more than 5 % probability
    together. If the rotation is undetermined, all other poses count. ``near`` is the total
    likelihood of further estimates near the best pose.
    """
    total = 1 + near + sum(likelihood for _, likelihood in others)
    is_open = covariance[:3, :3].trace() > (_LEAST_GAIN * _ANY_ROTATION) ** 2
    concealed = []
    for other, likelihood in others:
        turn = vector_from_rotation(other.rotation @ best.rotation.T)
        angle = float(np.linalg.norm(turn))
        along = float(turn @ covariance[:3, :3] @ turn) / max(angle, _LEAST_TURN) ** 4
        within = probability_within(1 / max(along, _LEAST_TURN), 1, degrees_of_freedom)
        if math.degrees(angle) > _ANOTHER_DEG and (is_open or within > _REGION):
            concealed.append((likelihood / total, math.degrees(angle)))
    share = sum(probability for probability, _ in concealed)
    if share <= 1 - _REGION:
        return ()
    _, angle = max(concealed)
    which = f"another pose, {angle:.0f} deg away, has"
    if len(concealed) > 1:
        which = f"other poses, the likeliest {angle:.0f} deg away, have"
    text = f"{which} a probability of {percent(share)}: see `alternatives`"
    return (EstimateWarning("alternative", text),)


def stretch_doubts(alignment: Alignment, std: Uncertainty, options: FitOptions) -> Warnings:
    """Warn about scales that are implausible under the prior or its default bounds."""
    found, prior = [], options.stretch_sigma
    most = math.log(USUAL_STRETCH) if prior is None else _BEYOND_PRIOR * prior
    for axis in range(3):
        scale = float(alignment.scale[axis] / alignment.scale[0])
        if abs(math.log(scale)) - std.scale[axis] > most:
            text = (
                f"the object is {scale:.3g} times as long along {'xyz'[axis]} as the model, "
                "relative to x: are the model's axes and keypoints right?"
            )
            found.append(EstimateWarning("stretch", text))
    return tuple(found)


@np.errstate(over="ignore")  # errors can be huge
def rejections(
    residuals: FloatArray, inliers: BoolArray, ransac: RansacOptions, sigma: Sigma | None
) -> Warnings:
    """Warn about many rejected keypoints, or many just beyond the threshold."""
    errors = np.linalg.norm(residuals[~inliers], axis=1)
    limit, share = ransac.threshold(sigma), len(errors) / max(len(inliers), 1)
    near = int((errors < _NEAR * limit).sum())
    is_tight = sigma is not None and near > 1 and 2 * near >= len(errors)
    if share <= _MOST_REJECTED and not is_tight:
        return ()
    text = f"{len(errors)} of {len(inliers)} keypoints ({percent(share)}) are rejected"
    if is_tight:
        text += f", {near} below {_NEAR:g} times the threshold, {limit:.3g} px: is sigma too small?"
    return (EstimateWarning("outlier", text),)


@np.errstate(over="ignore")  # image sizes can be huge
def outside_image(
    points_2d: FloatArray,
    camera: Camera,
    *,
    cause: EstimateWarning | None,
    sigma: Any = None,
    view: int = 0,
    where: str = "",
) -> Warnings:
    """Warn about an implausible camera, and about keypoints (n, 2) that are not in the image.

    They lie beyond one side of it; or, if there is a ``cause`` of a misfit, most lie outside; or
    they span hardly more than ``sigma`` [px]. ``where`` begins the texts.
    """
    agree, confirm = cause is None or cause.kind == "mistake", len(points_2d) > LEAST_POINTS
    confirm &= cause is None or cause.kind not in ("misfit", "camera", "noise")
    own, size = np.array([camera.width, camera.height]), f"{camera.width} x {camera.height} px"
    doubts = camera_doubts(camera, is_tested=confirm)
    found = [EstimateWarning("camera", where + text, view) for text in doubts]
    extent = float(np.ptp(points_2d, axis=0).max()) if len(points_2d) > 1 else math.inf
    if np.ndim(sigma) == 0 and sigma is not None and extent < _LEAST_EXTENT * sigma:
        text = f"{where}the keypoints span {extent:.2g} px, and sigma is {sigma:g} px: are these "
        found.append(EstimateWarning("unit", text + "pixels?", view))
    outside = np.flatnonzero(~camera.contains(points_2d)).tolist()
    if 2 * len(outside) <= len(points_2d):
        return tuple(found)
    last = own - PIXEL_CENTRE
    beyond = (points_2d < -PIXEL_CENTRE).all(axis=0) | (points_2d > last).all(axis=0)
    if beyond.any() or not agree:
        text = (
            f"{where}{len(outside)} of {len(points_2d)} keypoints lie outside of the image of "
            f"{size}: are they of another resolution than the camera, or of another photo?"
        )
        found.append(EstimateWarning("outside-image", text, view, tuple(outside)))
    return tuple(found)


def noise_doubts(sigma: float, points_2d: Sequence[FloatArray]) -> Warnings:
    """Warn if an estimated sigma [px] is nearly the spread of the views' keypoints (n, 2).

    The limit accepts 98 % of pairs of a category's models, and 2 % of random correspondences.
    """
    with np.errstate(over="ignore"):  # keypoints can be far outside
        spread = max(float(points.std(axis=0).max()) for points in points_2d if len(points))
    if sigma <= _LARGEST_SHARE * spread:
        return ()
    share = f"{sigma:.3g} px, {100 * sigma / spread:.0f} % of the keypoints' standard deviation"
    text = f"sigma is {share}: the model explains almost nothing, check the correspondences"
    return (EstimateWarning("noise", text),)


def is_large_sigma(sigma: float, points_2d: Sequence[FloatArray]) -> bool:
    """True if an estimated sigma [px] is large relative to the extent of keypoints (n, 2)."""
    extents = [float(np.ptp(points, axis=0).max()) for points in points_2d if len(points)]
    return sigma > _LARGE * max(extents, default=0.0)
