"""The principal point as two further unknowns, with a prior: of photos that may be cropped.

Newton's method on the principal point alone, everything else being estimated anew for each. By the
envelope theorem the gradient of the cost at the best estimate is that of the residuals, since a
principal point moves all projections alike. Its differences are the information about the principal
point once all other unknowns follow; those of the estimates are what it adds to their uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.options import FitOptions, Sigma, pixel_information
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import Stated
from cadalign.estimation.uncertainty.posterior import Likelihood
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import vector_from_rotation

_MOST_STEPS = 20
_SETTLED = 1e-3  # of a standard deviation
_DIFFERENCE = 1e-3  # of the prior's standard deviation, between estimates that are compared
_FROM_KEYPOINTS = ("mask", "image", "depth")


def estimate_with_principal_point(
    estimate_at: Callable[[FloatArray], Result], options: FitOptions, sigmas: Sequence[Sigma | None]
) -> Result:
    """Estimate everything and the principal point that the views have in common.

    ``estimate_at`` makes the estimate with cameras whose principal points are `shifted` by (2,)
    float [px]; ``sigmas`` are the standard deviations of each view's keypoints [px], None for the
    result's estimate. Covariances of the result hold what the principal point adds. Raises
    DegenerateError if the steps do not settle.
    """
    assert options.principal_sigma is not None
    prior, difference = options.principal_sigma**-2, _DIFFERENCE * options.principal_sigma
    shift = np.zeros(2)
    for _ in range(_MOST_STEPS):
        result = estimate_at(shift)
        gradient = _gradient(result, options, sigmas)
        beside = [estimate_at(shift + step) for step in difference * np.eye(2)]
        slopes = np.stack([_gradient(each, options, sigmas) - gradient for each in beside])
        information = (slopes + slopes.T) / (2 * difference)
        values, axes = np.linalg.eigh(information)  # far from the optimum some may be negative
        covariance = (axes / (np.abs(values) + prior)) @ axes.T
        step = -covariance @ (gradient + shift * prior)
        step *= min(1.0, options.principal_sigma / float(np.linalg.norm(step) or 1.0))
        if (np.abs(step) <= _SETTLED * np.sqrt(covariance.diagonal())).all():
            found = _with_principal_point(result, beside, difference, covariance, options)
            assert result.cost is not None
            return replace(found, cost=result.cost + prior * float(shift @ shift))
        shift = shift + step
    raise DegenerateError(
        "the estimate of the principal point does not settle",
        where="principal_sigma",
        fix="give a smaller one, or more keypoints",
    )


def shifted(camera: Camera, shift: FloatArray) -> Camera:
    """The camera with its principal point moved by (2,) float [px]."""
    return replace(camera, cx=camera.cx + float(shift[0]), cy=camera.cy + float(shift[1]))


def check_shiftable(views: Sequence[View]) -> None:
    """Refuse views of several cameras, and evidence beside keypoints that a camera measures."""
    for number, view in enumerate(views):
        if view.camera != views[0].camera:
            raise InputError(
                f"the camera of views[{number}] differs from that of views[0]",
                where="principal_sigma",
                fix="give views of one camera",
            )
        for name in _FROM_KEYPOINTS:
            given = getattr(view, name)
            if given is not None and np.ndim(given) != 1:
                raise InputError(
                    f"the principal point is estimated from keypoints, not from a {name}",
                    where=f"views[{number}].{name}",
                    fix="leave out one of the two",
                )


def _gradient(result: Result, options: FitOptions, sigmas: Sequence[Sigma | None]) -> FloatArray:
    """Half the derivative (2,) of the cost of a result by the principal point of its views."""
    total = np.zeros(2)
    for view, given in zip(result.views, sigmas, strict=True):
        sigma = result.sigma if given is None else given
        residuals = view.residuals[view.inliers]
        information = pixel_information(sigma, len(view.inliers))[view.inliers]
        weights = Likelihood(information, options).weights(residuals)
        total += np.einsum("n,nij,nj->i", weights, information, residuals)
    return total


def _with_principal_point(
    result: Result,
    beside: Sequence[Result],
    difference: float,
    covariance: FloatArray,
    options: FitOptions,
) -> Result:
    views = []
    for number, view in enumerate(result.views):
        # Those of the result are of its first view, and also name what was left out.
        stated = Stated.of(view.statistics if number else result.statistics)
        if stated.covariance is not None:
            steps = [_step(result, each, number) for each in beside]
            slopes = np.stack(steps, axis=-1)[: len(stated.covariance)] / difference
            added = slopes @ covariance @ slopes.T
            fisher = stated.fisher_covariance
            stated = replace(
                stated,
                covariance=stated.covariance + added,
                fisher_covariance=None if fisher is None else fisher + added,
            )
        for name, points_of in _POINTS.items():
            if getattr(stated, name) is not None:
                moved = [points_of(each) - points_of(result) for each in beside]
                slopes = np.stack(moved, axis=-1) / difference
                added = slopes @ covariance @ slopes.swapaxes(1, 2)
                stated = replace(stated, **{name: getattr(stated, name) + added})
        basis = stated.basis and replace(stated.basis, principal_sigma=options.principal_sigma)
        views.append(replace(view, statistics=replace(stated, basis=basis)))
    x, y = np.sqrt(covariance.diagonal()).tolist()
    return replace(
        result,
        views=tuple(views),
        statistics=views[0].statistics,
        principal_std=(x, y),
        options=None if result.options is None else options,
    )


_POINTS: dict[str, Callable[[Result], FloatArray]] = {
    "points_covariance": lambda result: result.points_3d * result.alignment.scale,
    "points_cam_covariance": lambda result: result.alignment.apply(result.points_3d),
}
"""Points of a result whose covariances are stated, by the name of these."""


def _step(one: Result, other: Result, number: int) -> FloatArray:
    """Rotation vector, translation, log lengths and log focal length (10,) between two results."""
    first, second = one.views[number], other.views[number]
    turn = vector_from_rotation(second.alignment.rotation @ first.alignment.rotation.T)
    shift = second.alignment.translation - first.alignment.translation
    lengths = np.log(other.stretch / one.stretch)
    return np.concatenate([turn, shift, lengths, [np.log(second.camera.fx / first.camera.fx)]])
